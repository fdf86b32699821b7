"""The interior-point protocol on a network: what agents know of the whole team, through loss, delay, crashes, departures and lies."""

import dataclasses
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import numpy as np
import pytest

from consat.faults import Faults
from consat.network.deploy.rehearsal import Rehearsal
from consat.network.node import guard, pair_core
from consat.network.node.build import core_of
from consat.network.node.core import Moment
from consat.network.node.embodied import Embodied
from consat.network.node.modes import NodeSettings
from consat.network.node.pairs import HEAD, MessageLayout, Packing
from consat.network.node.part import split
from consat.network.transports.memory import MemoryNetwork
from consat.network.wire import Message, encode
from consat.numerics import float64
from consat.scenario import load, loads
from tests.networked.case_c import events

MANNER = NodeSettings("interior-point", report=0.0)
BEST = {"case-c": math.inf, "case-d": -0.0814394460511299}
"""The upper bound that `consat solve` proves of the best margin; of the feasible team nobody asks."""
CONDITIONS = {
    "perfect": Faults(),
    "loss": Faults(loss=0.3),
    "delay": Faults(delay=(0.05, 0.2)),
    "all": Faults(loss=0.3, delay=(0.0, 0.05), repeat=0.3),
}


def team_of(name: str, conditions: Faults | None = None, seed: int = 0, **options: Any) -> Rehearsal:
    return Rehearsal(split(load(name), run=name, **options), MANNER, MemoryNetwork(replace(conditions or Faults(), seed=seed)))


def known(team: Rehearsal) -> dict[str, tuple[str | None, bool]]:
    """What each agent knows, and whether that is all there is to find."""
    return {agent: (runner.station.known, runner.station.settled) for agent, runner in team.runners.items()}


def wait(team: Rehearsal, what: str | None, seconds: float = 10.0) -> None:
    """Until all know it, and that there is no more to find."""
    wanted = {(what, what is not None)}
    team.run(seconds, lambda: set(known(team).values()) == wanted)
    assert set(known(team).values()) == wanted, known(team)


def bounds(team: Rehearsal, since: float = 0.0) -> list[float]:
    """All that were reported."""
    return [event["bound"] for event in team.events if event["event"] == "report" and event["bound"] is not None and event["t"] >= since]


def assert_no_false_word(team: Rehearsal, name: str) -> None:
    """Nobody ever proved too much, or believed what is not so."""
    if name == "case-d":
        assert bounds(team)
        assert min(bounds(team)) >= BEST[name]
        assert not events(team, "satisfied")
    else:
        assert not events(team, "infeasible")


@pytest.mark.parametrize("how", CONDITIONS)
@pytest.mark.parametrize(("name", "what"), [("case-c", "satisfied"), ("case-d", "infeasible")])
def test_all_agents_know_what_is_so(name: str, what: str, how: str) -> None:
    team = team_of(name, CONDITIONS[how])
    team.start()
    wait(team, what)
    if name == "case-d":  # near the best means within 5 % of it
        told = [event for event in events(team, "infeasible") if event["near"]]
        assert all(event["margin"] >= 1.06 * BEST[name] and event["bound"] < 0 for event in told)  # type: ignore[operator]
    team.run(0.5)
    assert_no_false_word(team, name)


@pytest.mark.parametrize(("name", "what"), [("case-c", "satisfied"), ("case-d", "infeasible")])
def test_survives_a_crash_without_memory_and_a_partition(name: str, what: str) -> None:
    """Who crashed begins at its body with nothing in its inbox. Nobody says that all are satisfied, or near, of those it does not hear."""
    team = team_of(name, Faults(loss=0.3))
    team.start()
    wait(team, what)
    team.kill("a2")
    team.run(1.0)
    assert {told for _, told in known(team).values()} == {False}
    assert {word for word, _ in known(team).values()} == {None if name == "case-c" else "infeasible"}  # which stays so
    team.bodies["a2"].follow(np.array([30.0, -40.0]), team.network.now)
    team.start("a2")
    wait(team, what)
    team.network.partition({"a1"}, {"a2", "a3"})
    team.run(1.0)
    assert {told for _, told in known(team).values()} == {False}
    team.network.partition()
    wait(team, what)
    assert_no_false_word(team, name)


def test_one_without_neighbours_knows_by_itself() -> None:
    lines = "{kind: within, center: [0, 0], radius: 1}, {kind: within, center: [4, 0], radius: 1}"
    team = Rehearsal(split(loads(f"consat: 1\nagents:\n  - {{id: a, constraints: [{lines}]}}\n"), run="solo"), MANNER, MemoryNetwork())
    team.start()
    wait(team, "infeasible")
    assert min(bounds(team)) >= -3.0  # halfway, 1 − 2²


@pytest.mark.parametrize("how", ["leave", "give-up"])
def test_a_proof_ends_with_the_team_that_it_is_of(how: str) -> None:
    """a3 makes case D infeasible. When it has gone, a1, which holds no copy of its position, and is not told that it has, must forget
    what was proven; when it is back, it is so again."""
    team = team_of("case-d", Faults(loss=0.3))
    team.start(give_up=2.0 if how == "give-up" else math.inf)
    wait(team, "infeasible")
    if how == "leave":
        team.runners["a3"].leave()
        team.run(1.0)
        assert "a3" not in team.runners
    else:
        team.kill("a3")
        team.run(2.5)
    assert {event["id"] for event in events(team, "left")} == {"a2"}
    since = team.network.now
    wait(team, "satisfied")
    team.run(0.5)
    assert set(known(team)) == {"a1", "a2"}
    assert min(bounds(team, since)) > 0
    team.start("a3")
    wait(team, "infeasible")
    assert min(bounds(team)) >= BEST["case-d"]


@float64
def test_a_proof_of_another_team_is_not_used() -> None:
    """Of a message that was on its way when the team changed, the quadratic counts, but not the proof, nor what was proven before."""
    team = team_of("case-d")
    team.start()
    wait(team, "infeasible")
    station, state = team.runners["a1"].station, team.runners["a1"]._state  # type: ignore[attr-defined]
    last = station.peers.all["a2"].last
    assert last is not None
    inbox, arrived = station.core.empty()
    station.codec.decode("a2", last.arrays, inbox, arrived)
    assert arrived.pair.tolist() == [True]
    found = {}
    for mine, theirs in ((0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)):
        inbox.pair[0, 0] = theirs
        inner, proven = state.core.inner, np.full(2, np.inf)
        inner = inner._replace(memory=inner.memory._replace(changes=np.array([mine]), bound=np.full(1, np.inf)))
        changed = state._replace(core=state.core._replace(inner=inner, bounds=proven))
        found[mine, theirs] = station.core.turn(changed, inbox, arrived, moment(station.core))[2].bound
    assert found[1.0, 0.0] == math.inf
    assert found[0.0, 0.0] == found[1.0, 1.0] == found[0.0, 1.0] == pytest.approx(BEST["case-d"], rel=0.05)


def test_one_that_was_absent_joins() -> None:
    team = team_of("case-d", Faults(loss=0.3), absent=("a3",))
    team.start("a1", "a2")
    wait(team, "satisfied")
    assert not events(team, "infeasible")
    team.start("a3")
    wait(team, "infeasible")
    assert min(bounds(team, team.network.now)) >= BEST["case-d"]


def test_lockstep_survives_a_departure() -> None:
    team = Rehearsal(
        split(load("case-d"), run="lockstep"), NodeSettings("lockstep", rate=100.0, report=0.0), MemoryNetwork(Faults(loss=0.3))
    )
    team.start()
    wait(team, "infeasible")
    team.runners["a3"].leave()
    team.run(1.0)
    wait(team, "satisfied")


# -- lies ----------------------------------------------------------------------------------------------------------------------------------

Change = Callable[[np.ndarray, MessageLayout], None]


def forge(team: Rehearsal, source: str, victim: str, change: Change) -> None:
    """A message of a neighbour whose mail is changed, put into the victim's inbox."""
    station = team.runners[victim].station
    last, (known,) = station.peers.all[source].last, [each for each in station.part.neighbours if each.id == source]
    assert last is not None
    assert last.arrays
    mail = last.arrays[1].copy()
    change(mail, MessageLayout.of(known, 2))
    team.network._open[victim].queue.append(encode(_next(last, mail)))


def _next(last: Message, mail: np.ndarray) -> Message:
    return dataclasses.replace(last, sequence=last.sequence + 1, arrays=(last.arrays[0], mail, *last.arrays[2:]))


def put(value: float, *places: int) -> Change:
    def change(mail: np.ndarray, layout: MessageLayout) -> None:
        mail[list(places)] = value

    return change


def quadratic(value: float, *, proof: bool) -> Change:
    """A multiple of the identity."""

    def change(mail: np.ndarray, layout: MessageLayout) -> None:
        size = layout.size - (layout.level if proof else 0)
        at = _tail(layout) + 3 if proof else HEAD
        triangle = np.zeros((size, size))
        np.fill_diagonal(triangle, value)
        mail[at : at + size * (size + 1) // 2] = triangle[np.triu_indices(size)]

    return change


def weight(value: float) -> Change:
    return lambda mail, layout: mail.__setitem__(_tail(layout), value)


def bound(value: float) -> Change:
    """A proof that the margin is at most about `value`."""

    def change(mail: np.ndarray, layout: MessageLayout) -> None:
        mail[_tail(layout) :] = 0.0
        mail[_tail(layout) : _tail(layout) + 2] = 1e6, 1e6 * value
        quadratic(1.0, proof=True)(mail, layout)

    return change


def _tail(layout: MessageLayout) -> int:
    return HEAD + layout.size * (layout.size + 1) // 2 + layout.size


REFUSED = {
    "an indefinite quadratic": (quadratic(-1.0, proof=False), "sense"),
    "an indefinite proof": (quadratic(-1.0, proof=True), "sense"),
    "a negative weight": (weight(-0.5), "sense"),
    "a negative barrier": (put(-2.0, 1), "sense"),
    "a fraction of a change": (put(0.5, 0), "sense"),
    "more changes than there can be": (put(1e15, 0), "number"),
    "no number": (put(math.nan, 2), "number"),
    "a level at ∞": (put(math.inf, 2), "number"),
    "a quadratic of 1e300": (quadratic(1e300, proof=False), "number"),
}
TAKEN = {
    "a level of −1e99": put(-1e99, 2),
    "a level of 1e99": put(1e99, 2),
    "a barrier of 1e99": put(1e99, 1),
    "a quadratic of 1e99": quadratic(1e99, proof=False),
    "a margin of ∞": put(math.inf, 3),
    "a margin of −∞": put(-math.inf, 3),
    "a proof that there is no hope": bound(-5.0),
    "a change of the team": put(7.0, 0),
}
"""Finite and of sense, so they are believed; forgotten in time."""


@pytest.fixture
def satisfied() -> Rehearsal:
    team = team_of("case-c")
    team.start()
    wait(team, "satisfied")
    return team


def test_mail_that_makes_no_sense_is_refused_and_counted(satisfied: Rehearsal) -> None:
    """Sent to the middle of the line, and to one of its ends, which hears nobody else."""
    for change, _ in REFUSED.values():
        for source, victim in (("a1", "a2"), ("a2", "a3")):
            forge(satisfied, source, victim, change)
        satisfied.run(0.05)
    reasons = [reason for _, reason in REFUSED.values()]
    for victim in ("a2", "a3"):
        assert satisfied.runners[victim].station.peers.dropped == {reason: reasons.count(reason) for reason in set(reasons)}
    wait(satisfied, "satisfied", 0.0)
    assert min(bounds(satisfied)) > 0
    assert not events(satisfied, "unsatisfied")


@pytest.mark.parametrize("lie", TAKEN)
def test_a_lie_that_makes_sense_does_no_lasting_harm(satisfied: Rehearsal, lie: str) -> None:
    for source, victim in (("a1", "a2"), ("a2", "a3")):
        forge(satisfied, source, victim, TAKEN[lie])
    satisfied.run(0.05)
    for victim in ("a2", "a3"):  # what the neighbour itself says next has the number that the forger took
        assert satisfied.runners[victim].station.peers.dropped["duplicate"] == 1
    hopeless = lie == "a proof that there is no hope"
    if hopeless:
        assert {"a2", "a3"} <= {event["id"] for event in satisfied.events if event["event"] == "report" and (event["bound"] or 1.0) < 0}
    satisfied.run(2.0 * pair_core.FORGET / 100.0 + 0.5 if hopeless else 5.0)
    wait(satisfied, "satisfied", 0.0)
    assert all(np.isfinite(place).all() for place in satisfied.positions().values())
    assert min(bounds(satisfied, satisfied.network.now - 0.05)) > 0
    assert not events(satisfied, "anew")


# -- pieces --------------------------------------------------------------------------------------------------------------------------------


def core(name: str = "case-c", agent: str = "a2") -> Embodied:
    return core_of(split(load(name), run="x")[agent], NodeSettings("interior-point"))


def moment(made: Embodied) -> Moment:
    return Moment(0.0, 0.01, np.zeros(len(made.ends)), np.ones(len(made.ends), dtype=bool), np.zeros(2))


@float64
def test_a_turn_is_compiled_once() -> None:
    made = core()
    compiled = pair_core._turn.program()  # type: ignore[attr-defined]
    compiled.clear_cache()
    state = made.begin(made.part.first)
    for _ in range(3):
        state, _, _ = made.turn(state, *made.empty(), moment(made))
    assert compiled._cache_size() == 1


@float64
def test_guard_leaves_out_whose_mail_is_poison() -> None:
    """The checker refuses what is no number before; whatever it may overlook, the state stays finite."""
    made = core()
    state = made.begin(made.part.first)
    inbox, arrived = made.empty()
    arrived.pair[:] = True
    good = guard.turn(made, state, inbox, arrived, moment(made))
    assert good.refused == ()
    inbox.pair[0, 1:] = math.nan
    got = guard.turn(made, state, inbox, arrived, moment(made))
    assert got.refused == ("a1",)
    assert all(np.isfinite(leaf).all() for leaf in (got.view.x, got.outbox.link))
    np.testing.assert_array_equal(got.view.x, good.view.x)


RELAYED = """
consat: 1
agents:
  - {id: a, constraints: [{kind: near, agent: c, radius: 1}]}
  - {id: b, constraints: [{kind: near, agent: a, radius: 1}]}
  - {id: c, constraints: [{kind: within, center: [0, 0], radius: 1}]}
communication: {graph: line}
"""


@float64
def test_what_is_packed_is_unpacked_and_nothing_else_is_said() -> None:
    """Of symmetric matrices the triangles, and of all only what the two share."""
    whole = split(loads(RELAYED), run="x")["b"]
    made = core_of(whole, NodeSettings("interior-point"))
    interior = made.core.solver.interior
    assert interior is not None
    width = interior.plan.width
    packing, layouts = Packing.of(whole, whole, width), [MessageLayout.of(neighbour, 2) for neighbour in whole.neighbours]
    assert [layout.size for layout in layouts] == [5, 3]  # b tells a of a, c and the level; c only of c
    random = np.random.default_rng(0)

    def drawn(leaf: np.ndarray) -> np.ndarray:
        values = random.normal(size=leaf.shape)
        return values + values.swapaxes(1, 2) if values.ndim == 3 else values

    mail = jax.tree.map(drawn, interior.silence())
    numbers = np.asarray(packing.pack(mail._replace(changes=np.full(2, 3.0))))
    assert [np.flatnonzero(row)[-1] + 1 for row in numbers] == [layout.length for layout in layouts]
    back = packing.unpack(numbers)
    assert np.asarray(back.changes).tolist() == [3.0, 3.0]
    for row, layout in enumerate(layouts):
        p, q = layout.size, layout.size - 1
        for got, sent in ((back.matrix, mail.matrix), (back.vector, mail.vector)):
            np.testing.assert_array_equal(got[row][(slice(p),) * (got.ndim - 1)], sent[row][(slice(p),) * (got.ndim - 1)])
        np.testing.assert_array_equal(back.proof.matrix[row, :q, :q], mail.proof.matrix[row, :q, :q])
        assert not np.asarray(back.proof.matrix)[row, q:].any()  # of the level nothing is proven
    for leaf in ("barrier", "level", "margin"):
        np.testing.assert_array_equal(getattr(back, leaf), getattr(mail, leaf))


@float64
def test_mail_keeps_its_places_when_somebody_has_gone() -> None:
    """And is 0 where it was about them."""
    whole = split(loads(RELAYED), run="x")["b"]
    less = core_of(whole, NodeSettings("interior-point")).without({"a"})
    assert [neighbour.id for neighbour in less.part.neighbours] == ["c"]
    state = less.begin(less.part.first)
    _, said, _ = less.turn(state, *less.empty(), moment(less))
    (layout,) = [MessageLayout.of(neighbour, 2) for neighbour in whole.neighbours if neighbour.id == "c"]
    assert said.pair.shape == (1, layout.length)
    assert layout.numbers().sound is not None
    assert layout.numbers().sound(said.pair[0])  # type: ignore[misc]


@pytest.mark.parametrize("protocol", ["interior-point", "max-min"])
def test_a_part_tells_what_travels_and_along_which_links(protocol: str) -> None:
    """Of a ring max-min uses a tree, whose missing link makes its ends no neighbours. In both the level crosses all links but one."""
    agents = "\n".join(f"  - {{id: a{i}, constraints: [{{kind: near, agent: a{i % 4 + 1}, radius: 1}}]}}" for i in (1, 2, 3, 4))
    text = f"consat: 1\nagents:\n{agents}\ncommunication: {{graph: ring}}\nprotocol: {{kind: {protocol}}}\n"
    made = split(loads(text))
    pairs = {(agent, neighbour.id): neighbour for agent, part in made.items() for neighbour in part.neighbours}
    tree = protocol == "max-min"
    assert len(pairs) == (6 if tree else 8)
    assert sum(neighbour.level for neighbour in pairs.values()) == 6
    for (agent, other), neighbour in pairs.items():
        back = pairs[other, agent]
        assert (back.travels, back.level) == (neighbour.travels, neighbour.level)
    assert {(part.hops, part.exact) for part in made.values()} == {(3, True) if tree else (2, False)}
