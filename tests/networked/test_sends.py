"""Agents on a network that send only what is news."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from consat.errors import InvalidSettings
from consat.faults import Faults
from consat.network.deploy.rehearsal import Rehearsal
from consat.network.node.modes import NodeSettings
from consat.network.node.part import split
from consat.network.transports.memory import MemoryNetwork
from consat.network.wire import Kind, Message, encode
from consat.scenario import load


def rehearse(settings: NodeSettings, conditions: Faults = Faults(), seed: int = 0) -> Rehearsal:  # noqa: B008
    team = Rehearsal(split(load("case-c"), run="sends"), settings, MemoryNetwork(replace(conditions, seed=seed)))
    team.start()
    return team


def sent(team: Rehearsal, what: str = "messages") -> int:
    return sum(runner.station.peers.sent[what] for runner in team.runners.values())


def satisfied(team: Rehearsal) -> bool:
    return all(runner.station.known == "satisfied" for runner in team.runners.values())


@pytest.mark.parametrize("mode", ["interior-point", "admm"])
@pytest.mark.parametrize("conditions", [Faults(), Faults(loss=0.3, delay=(0.0, 0.02))], ids=["perfect", "loss"])
def test_all_know_and_then_only_hearts_beat(mode: Any, conditions: Faults) -> None:
    team = rehearse(NodeSettings(mode, sends="events"), conditions)
    assert team.run(20.0, until=lambda: satisfied(team))
    team.run(20.0)
    before = sent(team)
    team.run(4.0)
    assert satisfied(team)
    assert sent(team) - before <= 1.2 * 4 * 4.0 * 100 / 8, "of four ends of links, each 8 turns of 100 a second one message"
    if not conditions.loss:
        assert not [event for event in team.events if event["event"] in ("unsatisfied", "refused", "down")]


def test_a_crashed_agent_is_told_everything_again() -> None:
    team = rehearse(NodeSettings("interior-point", sends="events"))
    assert team.run(20.0, until=lambda: satisfied(team))
    team.run(5.0)
    team.kill("a2")
    team.run(1.0)
    team.start("a2")
    assert team.run(10.0, until=lambda: satisfied(team))


def test_lockstep_says_in_few_bytes_that_nothing_is_new() -> None:
    bytes_ = {}
    for sends in ("all", "events"):
        team = rehearse(NodeSettings("lockstep", turns=200, report=0.0, sends=sends))  # type: ignore[arg-type]
        team.run(30.0, until=lambda team=team: all(runner._round >= 200 for runner in team.runners.values()))  # type: ignore[attr-defined, misc]
        bytes_[sends] = sent(team, "bytes")
    assert 2.5 * bytes_["events"] < bytes_["all"]


def test_agents_that_send_otherwise_are_not_understood() -> None:
    team = Rehearsal(split(load("case-c"), run="sends"), NodeSettings("interior-point"), MemoryNetwork())
    team.start("a1", "a3", sends="events")
    team.start("a2")
    team.run(1.0)
    assert team.runners["a1"].station.peers.dropped.keys() == {"problem"}


def test_another_version_is_refused_with_a_line() -> None:
    team = rehearse(NodeSettings("interior-point"))
    team.run(0.1)
    old = bytearray(encode(Message(Kind.GOODBYE, bytes(8), "a1", "a2", 1, 1, 0.0, np.nan, 0, 5.0)))
    old[4] = 3
    for _ in range(3):
        team.network.endpoint("a1", ["a2"]).send("a2", bytes(old))
        team.run(0.1)
    lines = [event["why"] for event in team.events if event["event"] == "refused" and "why" in event]
    assert lines == ["a neighbour speaks another version of the wire format than 4; update the team as a whole"]


def test_link_sends_all() -> None:
    with pytest.raises(InvalidSettings, match="mode link"):
        NodeSettings("link", sends="events")
    with pytest.raises(InvalidSettings, match="must be one of all, events"):
        NodeSettings("admm", sends="some")  # type: ignore[arg-type]
