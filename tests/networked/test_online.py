"""Constraints that move or are changed while agents are at work: clocks, orders, and what is proven meanwhile."""

from __future__ import annotations

import contextlib
import dataclasses
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import consat as cs
from consat.errors import InvalidSettings, InvalidTeam
from consat.faults import Faults
from consat.network.deploy.rehearsal import Rehearsal
from consat.network.node.modes import Mode, NodeSettings
from consat.network.node.orders import KEYS, Orders, order_of
from consat.network.node.part import read_part, split, write_part
from consat.network.transports.memory import MemoryNetwork
from consat.numerics import CompileClock
from consat.problem.changes import changes_of
from consat.problem.objective import margins
from consat.problem.schedule import Schedule
from consat.scenario import loads
from tests.networked.case_c import events

ESCORT = """
consat: 1
agents:
  - {id: a1, start: [0, 0], constraints: [{kind: within, center: {times: [0, 4], values: [[0, 0], [4, 2]]}, radius: 1, name: goal}]}
  - {id: a2, start: [0, 1], constraints: [{kind: near, agent: a1, radius: 1.5}]}
  - id: a3
    start: [0, 2]
    constraints: [{kind: expr, psi: "4 - norm2(a3 - [t, 0.5*t + 1])", name: track}, {kind: near, agent: a2, radius: 1.5}]
communication: {graph: line}
"""
STILL = ESCORT.replace("{times: [0, 4], values: [[0, 0], [4, 2]]}", "[0, 0]").replace("[t, 0.5*t + 1]", "[0, 1]")
FUZZED = loads(STILL).team
APART = STILL.replace("center: [0, 0]", "center: [20, 0]")


def team_of(text: str, mode: Mode = "interior-point", conditions: Faults | None = None, **options: Any) -> Rehearsal:
    scenario = loads(text + ("protocol: {kind: admm}\n" if mode == "admm" else ""))
    parts = split(scenario, run="online", epoch=options.pop("epoch", 0.0))
    made = Rehearsal(parts, NodeSettings(mode, rate=options.pop("rate", 50.0), report=0.0), MemoryNetwork(conditions), **options)
    made.start()
    return made


def worst(team: Rehearsal, text: str, since: float, until: float) -> float:
    """The least margin of the bodies over some time, each sampled at every turn, by the constraints as they truly were."""
    whole, tracks = loads(text).team, {agent: [] for agent in team.parts}
    for event in events(team, "report"):
        tracks[event["id"]] += event["track"]  # type: ignore[index, operator]
    found = math.inf
    for time in np.arange(since, until, 0.05):
        at = {agent: next(row[1:] for row in reversed(track) if row[0] <= time) for agent, track in tracks.items()}
        found = min(found, float(margins(whole.at(float(time)), at).min()))
    return found


def knows(team: Rehearsal) -> set[str | None]:
    return {runner.station.known for runner in team.runners.values()}


def bounds(team: Rehearsal, since: float = 0.0) -> list[float]:
    return [event["bound"] for event in events(team, "report") if event["bound"] is not None and event["t"] > since]  # type: ignore[misc, operator]


def bounds_below(team: Rehearsal, text: str) -> list[float]:
    """What is said in the next moments and is false of a team: bounds below the best margin, which is proven from below."""
    best, since = cs.solve(loads(text))["bounds"][0], team.network.now
    team.run(0.3)
    return [bound for bound in bounds(team, since) if bound < best - 1e-9]


@pytest.mark.parametrize("mode", ["interior-point", "admm"])
def test_agents_follow_constraints_that_move_by_clocks_that_differ(mode: Mode) -> None:
    """The goal goes at 1.1 a second, so that clocks 50 ms apart place it 0.06 apart. Nobody proves anything of what does not stay."""
    team = team_of(ESCORT, mode, Faults(loss=0.3), skew={"a1": 0.05, "a3": -0.05})
    team.run(5.0)
    assert worst(team, ESCORT, 0.5, 5.0) > 0.3
    assert knows(team) == {"satisfied"}
    assert not bounds(team)
    np.testing.assert_allclose(team.positions()["a1"], [4, 2], atol=0.9)


def test_who_knows_no_time_waits() -> None:
    """a2 has nothing that moves, and begins without: the others stand still until they are told."""
    team = team_of(ESCORT, epoch=None)
    team.run(4.0)
    assert {event["id"] for event in events(team, "report") if event["track"]} == {"a2"}
    for runner in team.runners.values():
        runner.station.epoch = 3.5
    team.run(6.0)
    assert knows(team) == {"satisfied"}


def test_a_moving_part_is_written_and_read_with_its_clock() -> None:
    for part in split(loads(ESCORT), epoch=1.7e9, generation=3).values():
        text = write_part(part)
        again = read_part(text, "part.yaml")
        assert (write_part(again), again.epoch, again.generation, again.team.moves) == (text, 1.7e9, 3, part.me != "a2")
        assert again.problem("admm") == part.problem("admm")


def test_lockstep_counts_time_in_rounds() -> None:
    """As `run` does, to rounding."""
    team = team_of(ESCORT, "lockstep", Faults(loss=0.3), rate=20.0, epoch=None)
    team.run(2.6)
    result = cs.run(loads(ESCORT), rate=20.0, rounds=40)
    places = {(event["id"], int(row[0])): row[1:] for event in events(team, "report") for row in event["track"]}  # type: ignore[union-attr]
    for k, agent in enumerate(("a1", "a2", "a3")):
        np.testing.assert_allclose(places[agent, 40], result.data["position"].values[40, k], atol=1e-9)


def test_a_changed_constraint_counts_from_the_next_turn_and_compiles_nothing() -> None:
    """Infeasible, proven; not so any more, and satisfied; and proven again. No bound is false for the team that it is said of."""
    best = cs.solve(loads(APART))["bounds"][1]
    team = team_of(APART, conditions=Faults(loss=0.3))
    team.run(8.0, lambda: knows(team) == {"infeasible"})
    assert knows(team) == {"infeasible"}
    with CompileClock() as clock:
        changed_at = team.network.now
        team.runners["a1"].change("goal", {"center": [0, 0]})
        team.run(8.0, lambda: knows(team) == {"satisfied"})
    assert clock.seconds["compile"] == 0.0
    assert knows(team) == {"satisfied"}
    told = [event for event in events(team, "changed") if event["id"] == "a1"]
    assert [(event["constraint"], event["parameters"]) for event in told] == [("goal", {"center": [0, 0]})]
    reports = [event for event in events(team, "report") if event["id"] == "a1" and event["bound"] is not None]
    assert all(event["bound"] > 0 for event in reports if event["t"] > changed_at)  # type: ignore[operator]
    assert min(bounds(team)) >= best
    assert not bounds_below(team, STILL)
    team.runners["a1"].change("goal", {"center": [20, 0]})
    team.run(8.0, lambda: knows(team) == {"infeasible"})
    assert knows(team) == {"infeasible"}


def test_what_was_proven_of_an_agent_that_begins_anew_with_other_constraints_is_not_used() -> None:
    """It counts no change, for it remembers none: its neighbours do."""
    team = team_of(APART)
    team.run(8.0, lambda: knows(team) == {"infeasible"})
    team.kill("a1")
    team.parts = {**team.parts, "a1": dataclasses.replace(team.parts["a1"], team=split(loads(STILL))["a1"].team)}
    team.start("a1")
    team.run(8.0, lambda: knows(team) == {"satisfied"})
    assert knows(team) == {"satisfied"}
    assert not bounds_below(team, STILL)


def test_nobody_proves_of_far_places_what_was_measured_near() -> None:
    """Where all can be, hundreds of reaches away, is outside the region that proofs speak of."""
    free = STILL.replace('{kind: expr, psi: "4 - norm2(a3 - [0, 1])", name: track}, ', "")
    team = team_of(free)
    team.run(8.0, lambda: knows(team) == {"satisfied"})
    team.runners["a1"].change("goal", {"center": [3000, 0]})
    team.run(4.0)
    assert knows(team) == {"satisfied"}
    assert not events(team, "infeasible")
    assert np.hypot(*(team.positions()["a3"] - [3000, 0])) < 4


def test_a_parameter_may_begin_to_move() -> None:
    team = team_of(STILL)
    team.run(8.0, lambda: knows(team) == {"satisfied"})
    team.runners["a1"].change("goal", {"center": {"times": [0, 3, 5], "values": [[0, 0], [0, 0], [1.5, 0]]}})
    team.run(8.0)
    assert knows(team) == {"satisfied"}
    assert np.hypot(*(team.positions()["a1"] - [1.5, 0])) < 1


BAD: list[tuple[str, dict[str, Any], str]] = [
    ("gaol", {"center": [0, 0]}, "there is no constraint 'gaol'; did you mean 'goal'?"),
    ("goal", {"centre": [0, 0]}, "there is no parameter 'centre' to change; did you mean 'center'?"),
    ("goal", {"center": [0, 0, 0]}, "must have 2"),
    ("goal", {"center": [0, math.nan]}, "center holds nan"),
    ("goal", {"radius": -1}, "radius is -1, but must be a positive number"),
    ("goal", {"radius": 10**400}, "of size at most"),
    ("goal", {"radius": True}, "radius is True"),
    ("goal", {"center": "a2"}, "center is 'a2'"),
    ("goal", {"weight": 0}, "weight is 0"),
    ("goal", {"center": {"times": [1, 0], "values": [[0, 0], [1, 1]]}}, "must rise"),
    ("goal", {"center": [1, 1], "radius": 0}, "radius is 0"),
]


@pytest.fixture(scope="module")
def settled() -> Rehearsal:
    team = team_of(STILL)
    team.run(8.0, lambda: knows(team) == {"satisfied"})
    return team


@pytest.mark.parametrize(("constraint", "parameters", "message"), BAD, ids=[message for *_, message in BAD])
def test_a_change_that_cannot_be_is_refused_and_nothing_changes(
    constraint: str, parameters: dict[str, Any], message: str, settled: Rehearsal
) -> None:
    """In the words that a session has."""
    station = settled.runners["a1"].station
    before = station.part, station.core
    with pytest.raises(InvalidTeam, match=message.replace("?", r"\?")) as refused:
        settled.runners["a1"].change(constraint, parameters)
    with pytest.raises(InvalidTeam) as here:
        changes_of(loads(STILL).team, "a1", constraint, parameters)
    assert str(refused.value) == str(here.value)
    assert (station.part, station.core) == before
    assert not events(settled, "changed")


def test_lockstep_keeps_its_constraints() -> None:
    team = team_of(STILL, "lockstep")
    with pytest.raises(InvalidSettings, match="mode lockstep goes as consat run does"):
        team.runners["a1"].change("goal", {"radius": 2})


def test_a_schedule_needs_a_clock() -> None:
    team = team_of(STILL, epoch=None)
    with pytest.raises(InvalidTeam, match="nobody has said when t = 0 is; start the agent with --epoch"):
        team.runners["a1"].change("goal", {"radius": {"times": [0, 1], "values": [1, 2]}})


def test_agents_of_another_split_are_not_understood() -> None:
    """What they say may travel along other links; in the same split they find each other."""
    team = team_of(STILL)
    team.kill("a3")
    team.parts = {**team.parts, "a3": dataclasses.replace(team.parts["a3"], generation=1)}
    team.start("a3")
    team.run(2.0)
    assert team.runners["a2"].station.peers.dropped["problem"] > 0
    assert not np.isfinite(team.runners["a2"].station.peers.all["a3"].heard)


_VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8) | st.sampled_from(["a1", "goal", 10**400, -0.0, 1e101]),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.sampled_from(["times", "values", "x"]), inner, max_size=3),
    max_leaves=6,
)
_ORDERS = st.dictionaries(
    st.sampled_from(["command", "constraint", "center", "radius", "weight", "epoch", "agent"]) | st.text(max_size=4),
    _VALUES | st.sampled_from(["change", "goal", "clock", "stop", "leave", "join", "reload"]),
    max_size=5,
)


@settings(max_examples=300, deadline=None)
@given(_ORDERS | _VALUES)
def test_whatever_an_order_is_it_is_understood_or_refused_in_one_line(told: Any) -> None:
    order = order_of(told, "line")
    if isinstance(order, str):
        assert order
        assert "\n" not in order
        return
    assert order.command in KEYS
    if order.command == "change":
        given = {key: value for key, value in order.given.items() if key != "constraint"}
        with contextlib.suppress(InvalidTeam):
            for change in changes_of(FUZZED, "a1", order.given["constraint"], given):
                for value in change.given.values():
                    arrays = (value.times, value.values) if isinstance(value, Schedule) else (value,)
                    assert all(np.isfinite(array).all() for array in arrays)


@pytest.mark.parametrize(
    "line", ["{", "[" * 10**5, '{"command": 1e999}', "nan", '{"command": "chang"}', '{"command": "stop", "x": 1}', "\x00"]
)
def test_a_line_that_is_no_order_is_refused(line: str) -> None:
    orders = Orders(2, reading=False)
    assert orders._take(line)
    assert not orders.stopped
    assert orders.next() is None
