"""Teams whose links form loops: quick over their links where they can be satisfied, exact and proven over a spanning tree where not."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import numpy as np
import pytest

import consat as cs
from consat.certify.optimum import max_min
from consat.runs.preparation import why_admm


def net(radius: float) -> cs.Team:
    """A square net of 3 by 2 agents, two corners in discs that are 3 apart."""
    count, links = 6, [(0, 1), (1, 2), (3, 4), (4, 5), (0, 3), (1, 4), (2, 5)]
    own: list[list[cs.Constraint]] = [[] for _ in range(count)]
    for i, j in links:
        own[j].append(cs.near(f"a{i}", radius))
    own[0].append(cs.within([0.0, 0.0], 0.5))
    own[5].append(cs.within([3.0, 0.0], 0.5))
    return cs.Team([cs.Agent(f"a{i}", constraints) for i, constraints in enumerate(own)], [(f"a{i}", f"a{j}") for i, j in links])


def test_a_torn_team_goes_over_to_a_spanning_tree_and_proves_that_it_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    team = net(0.5)
    exact = max_min(team).margin
    assert exact < -0.1, "the team is torn"
    result = cs.run(team, seed=1)
    summary = result.summary
    assert (summary["route"], summary["status"], summary["known"]) == ("tree", "least-violating", "infeasible")
    # 10 rounds, and 2 for each of the 3 hops across
    assert "had not satisfied the team after 16 rounds" in summary["why"]
    assert summary["margin"] == pytest.approx(exact, rel=0.05)
    bound = result.data["bound"].values
    assert np.isnan(bound[:17]).all(), "nothing is proven over loops"
    assert (bound[summary["known_from"] :] >= exact - 1e-6).all()
    # measured: 39
    assert summary["rounds"] <= 60

    # so does every run of a sweep, at the same round
    [row] = cs.sweep(team, seeds=[1]).runs
    assert {key: row[key] for key in ("rounds", "messages", "floats_sent")} == {
        key: summary[key] for key in ("rounds", "messages", "floats_sent")
    }
    assert row["margin"] == pytest.approx(summary["margin"], abs=1e-9)

    # and one that was interrupted after that, and taken up
    def interrupt(done: float, margin: float) -> None:
        if done * 2000 > 20:
            os.kill(os.getpid(), signal.SIGINT)

    cut = cs.run(team, seed=1, out=tmp_path, checkpoint=0.0, progress=interrupt).summary
    assert cut["ending"] == "interrupted"
    assert 16 < cut["rounds"] < summary["rounds"]
    went_on = cs.resume(tmp_path, team)
    assert {key: went_on.summary[key] for key in ("rounds", "margin", "messages", "known_from", "route")} == {
        key: summary[key] for key in ("rounds", "margin", "messages", "known_from", "route")
    }
    assert np.array_equal(went_on.data["position"], result.data["position"])

    # where the tree is too wide it stays on its links, and says that it didn't come to rest
    monkeypatch.setattr("consat.protocols.local.interior.routes.WIDE", 3)
    wide = cs.run(team, seed=1, rounds=30, stop="satisfied").summary
    assert (wide["route"], wide["known"]) == ("links", None)
    assert "more than 3" in wide["why"]
    assert "went round loops of links and had not come to rest after 30 rounds" in wide["warnings"][0]


def test_a_team_that_can_be_satisfied_stays_on_its_links() -> None:
    summary = cs.run(net(1.5), seed=1).summary
    assert (summary["route"], summary["status"], summary["known"]) == ("links", "satisfied", "satisfied")
    assert summary["satisfied_from"]["round"] <= 8  # measured: 3
    assert "goes over to a spanning tree" in summary["why"]
    assert summary["warnings"] == []


def test_long_loops_are_left_to_admm() -> None:
    count = 100
    turn = 2 * np.pi * np.arange(count) / count
    places = count / np.pi * np.column_stack([np.cos(turn), np.sin(turn)])
    agents = [cs.Agent(f"a{i}", [cs.near(f"a{i - 1}", 3)] if i else []) for i in range(count)]
    agents[0] = cs.Agent("a0", [cs.near(f"a{count - 1}", 3), cs.within(places[0], 1)])
    agents[50] = cs.Agent("a50", [cs.near("a49", 3), cs.within(places[50], 1)])
    summary = cs.run(cs.Team(agents), stop="satisfied").summary
    assert (summary["protocol"], summary["status"]) == ("admm", "satisfied")
    assert "loops of 100 agents" in summary["why"]
    assert summary["satisfied_from"]["round"] <= 60  # 1500 rounds of interior-point did not satisfy two of three rings of 200


def test_large_teams_with_many_links_are_left_to_admm() -> None:
    side = 17

    def meshed(offsets: list[tuple[int, int]]) -> cs.Team:
        there = [(x, y) for x in range(side) for y in range(side)]
        links = [((x, y), (x + u, y + v)) for x, y in there for u, v in offsets if (x + u, y + v) in set(there)]
        near = {at: [cs.near(f"a{x}-{y}", 2) for (x, y), other in links if other == at] for at in there}
        return cs.Team([cs.Agent(f"a{x}-{y}", near[x, y]) for x, y in there])

    assert why_admm(meshed([(1, 0), (0, 1)]), "local") is None
    assert "more than 250 agents with more than 3 links" in str(why_admm(meshed([(1, 0), (0, 1), (1, 1), (2, 1)]), "local"))
