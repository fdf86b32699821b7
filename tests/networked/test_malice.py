"""A neighbour that sends well-formed poison, once: whoever hears it finds its way back as soon as sense is spoken again.

The forger writes straight into the victim's inbox, in the neighbour's name and with the number that the neighbour would use next: what a
compromised robot with a valid key can do, or anybody where there are no keys.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from consat.network.deploy.rehearsal import Rehearsal
from consat.network.node import guard
from consat.network.node.build import core_of
from consat.network.node.core import Moment, Rows
from consat.network.node.lockstep import Lockstep
from consat.network.node.membership import MOST, Membership
from consat.network.node.modes import NodeSettings
from consat.network.node.round_core import RoundCore
from consat.network.wire import AHEAD, Kind, Message, encode
from consat.numerics import float64
from tests.networked.case_c import GOAL, parts, rehearse

SETTINGS = {"admm": NodeSettings("admm"), "link": NodeSettings("link", pace=20.0), "lockstep": NodeSettings("lockstep", rate=100.0)}
SETTLED = 2.0
"""Seconds in which each of them is near the optimum: the forger comes when all seems well."""


def off(team: Rehearsal) -> float:
    """The largest distance to the optimum on any axis; NaN if a position is."""
    return float(np.max([np.abs(team.positions()[agent] - np.array(goal)).max() for agent, goal in GOAL.items()]))


def forge(team: Rehearsal, source: str, victim: str, change: Callable[[Message], Message], times: int = 1) -> None:
    """Put changed messages of a neighbour into the victim's inbox."""
    last = team.runners[victim].station.peers.all[source].last
    assert last is not None
    for number in range(1, times + 1):
        team.network._open[victim].queue.append(encode(change(dataclasses.replace(last, sequence=last.sequence + number))))


def numbers(value: float, columns: slice = slice(0, -1)) -> Callable[[Message], Message]:
    """Every number of the state replaced; the last column tells who is there, those before it of bodies: place, staleness, age."""

    def change(message: Message) -> Message:
        arrays = [array.copy() for array in message.arrays]
        for array in arrays:
            if array.ndim == 2:
                array[:, columns] = value
        return dataclasses.replace(message, arrays=tuple(arrays))

    return change


def field(**values: Any) -> Callable[[Message], Message]:
    return lambda message: dataclasses.replace(message, **values)


def round_(value: float) -> Callable[[Message], Message]:
    return lambda message: dataclasses.replace(message, arrays=(*message.arrays[:2], np.array([value])))


PENALTY, PACE, PLACE, STALE, AGE, EPOCH = (slice(*ends) for ends in ((-7, -6), (-6, -5), (-5, -3), (-3, -2), (-2, -1), (-1, None)))
POISON = {
    "x = ∞": numbers(math.inf),
    "x = 1e300": numbers(1e300),
    "ρ = ∞": numbers(math.inf, PENALTY),
    "ρ = 1e99": numbers(1e99, PENALTY),
    "ρ = 1e−99": numbers(1e-99, PENALTY),
    "ρ = 0": numbers(0.0, PENALTY),
    "ρ = −1e99": numbers(-1e99, PENALTY),
    "ρ = −1": numbers(-1.0, PENALTY),
    "estimates satisfied for ever": numbers(math.inf, PACE),
    "estimates satisfied for less than no time": numbers(-1e99, PACE),
    "age = ∞": numbers(math.inf, AGE),
    "age = −1e99": numbers(-1e99, AGE),
    "age = 1e99": numbers(1e99, AGE),
    "a body at ∞": numbers(math.inf, PLACE),
    "a body at 1e99": numbers(1e99, PLACE),
    "word of a body from the future": numbers(-1e99, STALE),
    "word of a body from the far past": numbers(1e99, STALE),
    "word of a body from no time": numbers(math.inf, STALE),
    "everybody has left, the largest number": numbers(MOST - 1, EPOCH),
    "everybody has left": numbers(1.0, EPOCH),
    "everybody has left a fraction of times": numbers(1.5, EPOCH),
    "an echo from the past": field(echo=-1e300),
    "an echo from the future": field(echo=1e300),
    "sent in the past": field(sent=-1e300),
    "sent in the future": field(sent=1e300),
    "an absurd ν": field(nu_beta=1e300),
    "the largest incarnation": field(incarnation=2**64 - 1),
    "the largest sequence": field(sequence=2**64 - 1),
    "a sequence as far ahead as is believed": lambda message: dataclasses.replace(message, sequence=message.sequence + AHEAD - 1),
    "an early goodbye": field(kind=Kind.GOODBYE, arrays=()),
}
ROUNDS = {"round 1e15": round_(1e15), "round 1e300": round_(1e300), "round −1e300": round_(-1e300), "round 0": round_(0.0)}
LIES = {"admm": {"x = 1e30": numbers(1e30, slice(0, 2)), "ρ = e²⁰": numbers(math.exp(20.0), PENALTY)}, "link": {"x = 10": numbers(10.0)}}
"""Finite, so they are taken; forgotten in time. The flow does that at the pace of its slowest mode."""
CASES = {
    "admm": [*POISON, *LIES["admm"]],
    "link": ["x = ∞", "everybody has left, the largest number", "an echo from the past", *LIES["link"]],
    "lockstep": [*ROUNDS, "x = ∞", "everybody has left, the largest number", "the largest incarnation"],
}


@pytest.mark.parametrize(("mode", "poison"), [(mode, poison) for mode, poisons in CASES.items() for poison in poisons])
def test_one_poisoned_message_does_no_lasting_harm(mode: str, poison: str) -> None:
    """Sent to the middle of the line, and to one of its ends, which hears nobody else."""
    team = rehearse(SETTINGS[mode])
    team.run(SETTLED)
    assert off(team) < 1e-2
    for source, victim in (("a1", "a2"), ("a2", "a3")):
        forge(team, source, victim, (POISON | ROUNDS | LIES.get(mode, {}))[poison])
    for _ in range(5 if poison in LIES.get(mode, {}) else 3):
        team.run(2.0)  # what was believed, some 500 in the multipliers, is worked off at 0.3 a round
        if off(team) < 1e-3:
            break
    assert off(team) < 1e-3
    for agent, runner in team.runners.items():
        assert not runner.station.membership.gone, agent
        trips = [peer.trip for peer in runner.station.peers.all.values()]
        assert max(trips) < 0.1, "the mean round trip"


@float64
def test_guard_leaves_out_the_neighbour_whose_message_is_poison_and_hears_the_others() -> None:
    """The checker refuses infinite penalties before; whatever it may overlook, the state stays finite."""
    core = core_of(parts()["a2"], NodeSettings("admm"))
    state = core.begin(core.part.first)
    inbox, arrived = core.empty()
    inbox.link[:] = np.abs(np.random.default_rng(0).normal(size=inbox.link.shape))  # penalties are positive
    arrived.link[:] = arrived.pair[:] = True
    moment = Moment(0.0, 0.01, np.zeros(len(arrived.link)), arrived.link, np.zeros(2))
    good = guard.turn(core, state, inbox, arrived, moment)
    assert good.refused == ()
    np.testing.assert_array_equal(good.view.x, core.turn(state, inbox, arrived, moment)[2].x)
    from_a1 = np.array([neighbour == "a1" for neighbour, _ in core.ends])
    without = Rows(np.where(from_a1[:, None], 0.0, inbox.link), inbox.pair), Rows(~from_a1, arrived.pair)
    for poison in (math.inf, math.nan, -math.inf):
        spoilt = inbox._replace(link=np.where(from_a1[:, None], poison, inbox.link))
        assert not np.isfinite(core.turn(state, spoilt, arrived, moment)[2].x).all(), "negative control"
        got = guard.turn(core, state, spoilt, arrived, moment)
        assert got.refused == ("a1",)
        np.testing.assert_array_equal(got.view.x, core.turn(state, *without, moment)[2].x)
        everything = guard.turn(core, state, inbox._replace(link=np.full_like(inbox.link, poison)), arrived, moment)
        assert everything.refused == ("a1", "a3")
        assert np.isfinite(everything.view.x).all()


def test_refused_neighbours_are_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(RoundCore, "largest", property(lambda self: np.full(self.width, np.inf), lambda *_: None), raising=False)
    team = rehearse(SETTINGS["admm"])
    team.run(SETTLED)
    forge(team, "a1", "a2", POISON["ρ = ∞"])
    team.run(1.0)
    assert [(event["id"], event["peer"]) for event in team.events if event["event"] == "refused"] == [("a2", "a1")]
    assert off(team) < 1e-3


def test_a_flood_of_far_rounds_takes_no_memory() -> None:
    team = rehearse(SETTINGS["lockstep"])
    team.run(SETTLED)
    runner = team.runners["a2"]
    assert isinstance(runner, Lockstep)
    before = runner._round
    for number in range(300):
        forge(team, "a1", "a2", round_(before + 10.0 + 7 * number))
        runner._receive()
    assert all(len(blocks) <= 3 for blocks in runner._blocks.values())
    assert before - 1 in runner._blocks["a1"] or runner._round == before


def test_who_is_said_to_have_left_always_has_the_last_word() -> None:
    for claim in (1.0, 77.0, MOST - 1, MOST, MOST + 1, 2.0**53, 1e300, -1.0, 0.5):
        mine, other = Membership(parts()["a1"]), Membership(parts()["a2"])
        for _ in range(3):
            other.update(["a1"], np.array([claim]))
            mine.update(["a1"], other.of(["a1"]))
            other.update(["a1"], mine.of(["a1"]))
        assert not mine.gone, claim
        assert not other.gone, claim
