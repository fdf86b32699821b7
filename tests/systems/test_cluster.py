"""Several processes on this machine run a team as one process does, to rounding."""

from __future__ import annotations

import json
import os
import subprocess
import sysconfig
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import consat as cs
from consat.engine.partition import Share, assign
from consat.errors import InvalidSettings
from consat.processes import asked
from consat.protocols.estimates import Estimates

CONSAT = Path(sysconfig.get_path("scripts")) / "consat"
PATIENCE = 400


def lattice(side: int) -> cs.Team:
    agents = []
    for i in range(side * side):
        own = [cs.within([0, 0], 1)] if i == 0 else []
        own += [cs.displacement(f"a{i - 1}", [1, 0], 0.5)] if i % side else []
        own += [cs.displacement(f"a{i - side}", [0, 1], 0.5)] if i >= side else []
        agents.append(cs.Agent(f"a{i}", own))
    return cs.Team(agents)


def in_processes(scenario: Path | str, count: int, *options: str) -> dict[str, Any]:
    command = [CONSAT, "run", str(scenario), *options, "--processes", str(count), "--json"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE, check=False)
    assert done.returncode in (0, 4), done.stderr
    found: dict[str, Any] = json.loads(done.stdout)
    return found


def check_same(several: dict[str, Any], one: dict[str, Any]) -> None:
    """Counts are equal; sums are taken in another order, whose rounding the rounds carry on."""
    for name in ("status", "verdict", "rounds", "messages", "floats_sent", "satisfied_from", "known_from", "ending"):
        assert several[name] == one[name], name
    assert several["margin"] == pytest.approx(one["margin"], abs=1e-9)
    assert several["smooth_margin"] == pytest.approx(one["smooth_margin"], abs=1e-9)
    np.testing.assert_allclose(list(several["positions"].values()), list(one["positions"].values()), atol=1e-9)


@pytest.mark.parametrize(
    ("count", "options", "how"),
    [
        (
            2,
            ["--loss", "0.2", "--sleep", "0.1", "--rate", "10", "--speed", "2", "--rounds", "70", "--protocol", "admm"],
            {"loss": 0.2, "sleep": 0.1, "rate": 10, "speed": 2, "rounds": 70, "protocol": "admm"},
        ),
        (3, ["--rounds", "33", "--protocol", "proximal"], {"rounds": 33, "protocol": "proximal"}),
    ],
    ids=["two, with losses and bodies", "three, proximal"],
)
def test_processes_agree_with_one(count: int, options: list[str], how: dict[str, Any], tmp_path: Path) -> None:
    file, team = tmp_path / "lattice.yaml", lattice(6)
    file.write_text(cs.dump(team, name="lattice"))
    one = cs.run(cs.load(file), **how)
    check_same(in_processes(file, count, *options, "--out", str(tmp_path / "out")), one.summary)
    recorded = cs.Result.load(tmp_path / "out" / "result.nc").data
    assert set(recorded.variables) == set(one.data.variables)
    for name in ("position", "agent_margin", "margin", "estimate"):
        np.testing.assert_allclose(recorded[name].values, one.data[name].values, atol=1e-9, err_msg=name)


def test_processes_join_by_address_and_fail_together(tmp_path: Path) -> None:
    file = tmp_path / "lattice.yaml"
    file.write_text(cs.dump(lattice(4), name="lattice"))
    done = subprocess.run(
        [CONSAT, "run", file, "--protocol", "gradient-flow", "--processes", "2"],
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        check=False,
    )
    assert done.returncode == 2
    assert "several processes run protocols in rounds" in done.stderr
    assert asked("h:1", 0, 2, {}) == ("h:1", 0, 2)
    assert asked(None, None, None, {}) is None
    assert asked(None, 1, None, {"CONSAT_COORDINATOR": "h:1", "CONSAT_OF": "3"}) == ("h:1", 1, 3)
    with pytest.raises(InvalidSettings, match="all three"):
        asked("h:1", None, None, {})
    alone = [CONSAT, "run", file, "--coordinator", "127.0.0.1:1", "--process", "5", "--of", "2"]
    wrong = subprocess.run(alone, capture_output=True, text=True, timeout=PATIENCE, check=False, env=os.environ)
    assert (wrong.returncode, "numbered from 0 to 1" in wrong.stderr) == (2, True)


@pytest.mark.parametrize("processes", [2, 3, 5])
def test_shares_cover_the_team_and_cut_few_links(processes: int) -> None:
    team = lattice(12)
    copies = Estimates.of(team, "local")
    part = assign(team, copies, processes)
    sizes = np.bincount(part, minlength=processes)
    assert sizes.min() > 0.7 * team.count / processes
    # a straight cut through a lattice of 12 by 12 takes 12 links; the order's are slanted, and may take twice as many
    assert np.count_nonzero(part[copies.links[:, 0]] != part[copies.links[:, 1]]) <= 24 * (processes - 1)
    shares = [Share.of(team, copies, part, me, processes) for me in range(processes)]
    assert sorted(np.concatenate([share.agents[: share.mine] for share in shares])) == list(range(team.count))
    assert sorted(np.concatenate([share.rows[share.ours] for share in shares])) == list(range(copies.count))
    assert sum(len(share.team.owner) for share in shares) == len(team.owner)
    for share in shares:
        # every end's other end is here, too, and the rows' order is that which the layout needs
        ends = set(map(tuple, share.copies.edges))
        assert all((b, a) in ends for a, b in ends)
        keys = share.copies.holder.astype(np.int64) * len(share.agents) + share.copies.position
        assert (np.diff(keys) > 0).all()
    for me, other in ((0, 1), (1, 0)):
        # what one sends, the other puts where the same end of the same link stands
        sent = shares[me].copies.edges[shares[me].messages.out[other]]
        place = shares[other].messages.into[me]
        place = place[place < len(shares[other].copies.edges)]
        got = shares[other].copies.edges[place]
        np.testing.assert_array_equal(shares[me].rows[sent[: len(place)]], shares[other].rows[got])
