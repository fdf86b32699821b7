"""Protocols in rounds: what is counted and recorded as they go by, and when they end."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import jax
import numpy as np
from jax import Array

from consat.engine import Stop
from consat.engine.bodies import Body
from consat.engine.checkpoint import Checkpoint, fingerprint
from consat.engine.chunks import CHUNK, SURE, Chunk, Engine, Kept, OneProcess
from consat.engine.live import Live
from consat.engine.loop import Steps, follow
from consat.engine.recording import Choice, Memory, Rows, Sink, velocities
from consat.engine.round import BEST, INFEASIBLE, NEAR, SATISFIED, Now
from consat.engine.violations import shares
from consat.engine.world import World, world_of
from consat.faults import Faults
from consat.numerics import float64, quick_compilation
from consat.problem.objective import Nu
from consat.problem.team import Team
from consat.problem.units import Scale
from consat.protocols import Rounds
from consat.protocols.estimates import Estimates
from consat.results.trace import Ending, Trace
from consat.robots.conditions import conditions
from consat.robots.drive import Drive, Report
from consat.robots.simulated import Simulated

ENOUGH = {"satisfied": NEAR, "converged": BEST, "never": 0}
"""What all must know for a run to end, for each stop rule."""
WORD = 10
"""Where agents tell each other of their bodies, a satisfied team goes on until all know it, for at most so many rounds a hop more."""
FAR = 50
"""Across more hops than these nobody waits for word to get around."""
HOLD = 10
"""How many rounds on end every margin must stay positive before a team counts as satisfied."""
PATIENCE = 2000
"""How many rounds a team may take when nobody says."""
PATIENT = 1.5
"""Whether a team that stands still has no hope is asked again only when the run is so many times as long: the answer takes its time."""
TURN, TURN_HOP = 10, 2
"""A team that its links with their loops have not satisfied after so many rounds, and so many for each hop across it, goes over to a
spanning tree. Measured: random geometric graphs, rings and lattices of 9 to 100 agents are satisfied over their links by then, or torn."""
SETTLED = 1e-5
"""A team has settled when over a chunk no position moved by more than this fraction of the team's unit of length, …"""
SETTLED_ALL_THE_SAME = 1e-7
"""… or than this, where a certificate should say when it is `enough`."""


@dataclass
class Tally(Steps):
    """What is counted of rounds.

    Attributes:
        streak: for how many rounds every margin has been positive.
        near: for how many rounds all have known what ends the run; see `consat.engine.chunks.Ask`.
        known: what all know; see `consat.engine.round.knowledge`.
        infeasible_from: the round from which all have known that the team cannot be satisfied, or None.
        last_bad: the last round whose margin was ≤ 0, or −1.
        last_unknown: the last round after which not everybody knew, or −1.
        messages: sent.
        floats: sent.
        bytes: sent.
        smooth_margin: the last.
        bound: the last.
        held: after how many rounds, the start among them, every constraint held.
        first_held: the first round after which every constraint held, or None.
        held_since: after how many rounds from that one on they did.
        worst_since: the least margin from that one on.
        asked: the round at which it was last asked whether there is hope.
        turned: the round after which the team went over to a spanning tree, or None.
        violated: (W,) after how many rounds each watched constraint was violated; None where nobody counts.
    """

    streak: int = 0
    near: int = 0
    last_bad: int = -1
    last_unknown: int = -1
    messages: int = 0
    floats: int = 0
    bytes: int = 0
    smooth_margin: float = np.nan
    bound: float = np.nan
    asked: int = 0
    known: int = 0
    infeasible_from: int | None = None
    held: int = 0
    first_held: int | None = None
    held_since: int = 0
    worst_since: float = np.inf
    violated: Any = 0
    turned: int | None = None

    def add(self, chunk: Chunk) -> np.ndarray:
        """Count some rounds; gives their numbers."""
        count = int(chunk.done)
        numbers = np.arange(self.done + 1, self.done + 1 + count)
        margin, known = np.asarray(chunk.margin)[:count], np.asarray(chunk.known)[:count]
        bad, unknown = np.flatnonzero(~(margin > 0)), np.flatnonzero(known & SATISFIED == 0)
        torn = np.flatnonzero(known & INFEASIBLE)
        if self.infeasible_from is None and len(torn):
            self.infeasible_from = int(numbers[torn[0]])
        self.known, self.near = int(known[-1]), int(chunk.near)
        self._hold(numbers, margin)
        self.streak = self.streak + count if not len(bad) else count - 1 - int(bad[-1])
        self.last_bad = int(numbers[bad[-1]]) if len(bad) else self.last_bad
        self.last_unknown = int(numbers[unknown[-1]]) if len(unknown) else self.last_unknown
        self.messages += int(np.sum(np.asarray(chunk.messages)[:count]))
        self.floats += int(np.sum(np.asarray(chunk.floats)[:count]))
        self.bytes += int(np.sum(np.asarray(chunk.bytes)[:count]))
        self.violated = None if chunk.violated is None else np.asarray(self.violated) + np.asarray(chunk.violated)
        self.done += count
        self.margin, self.smooth_margin, self.bound = (float(leaf[count - 1]) for leaf in (chunk.margin, chunk.smooth_margin, chunk.bound))
        self.drift = float(chunk.drift) if count == CHUNK or not np.isfinite(chunk.drift) else np.inf
        return numbers

    def motion(self, period: float) -> dict[str, Any]:
        """Of ``run --json`` what is said of a team that moves; period: of a round, s."""
        since = 0 if self.first_held is None else self.done + 1 - self.first_held
        return {
            "duration": self.done * period,
            "satisfied_share": self.held / (self.done + 1),
            "satisfied_share_after": self.held_since / since if since else None,
            "worst_margin_after": self.worst_since if since else None,
        }

    def _hold(self, numbers: np.ndarray, margin: np.ndarray) -> None:
        good = margin > 0
        self.held += int(np.count_nonzero(good))
        if self.first_held is None and good.any():
            self.first_held = int(numbers[np.argmax(good)])
        if self.first_held is not None:
            since = margin[numbers >= self.first_held]
            self.held_since += int(np.count_nonzero(since > 0))
            self.worst_since = min(self.worst_since, float(since.min()))


def stillness(length: float, enough: Callable[[np.ndarray], bool] | None) -> float:
    """A chunk in which no position moved farther is one in which the team stood still; length: the team's unit."""
    return (SETTLED if enough is None else SETTLED_ALL_THE_SAME) * length


def longest_hold(protocol: Rounds, world: World) -> int:
    """How many rounds on end a team may be satisfied before its run ends, though not all know it."""
    hops = world.everyone.hops
    return HOLD + (WORD * (1 + hops) if protocol.speaks == "pair" and hops <= FAR else 0)


@float64
def simulate_rounds(
    team: Team,
    protocol: Rounds,
    copies: Estimates,
    nu: Nu,
    size: Scale,
    first: np.ndarray,
    *,
    convex: bool,
    rounds: int | None = None,
    least: int = 0,
    stop: Stop = "satisfied",
    faults: Faults | None = None,
    body: Body | None = None,
    record: bool | None = None,
    choice: Choice | None = None,
    sink: Sink | None = None,
    checkpoint: Checkpoint | None = None,
    hopeless: Callable[[np.ndarray], bool] = lambda _: False,
    enough: Callable[[np.ndarray], bool] | None = None,
    then: Estimates | None = None,
    events: bool = False,
    progress: Callable[[float, float], None] = lambda *_: None,
) -> Trace:
    """Run a protocol in rounds.

    Args:
        team: whose clusters are connected.
        protocol: what they do.
        copies: the layout of estimates.
        nu: the smoothing.
        size: the team's natural size.
        first: (C, d) first estimates, with x_i^(i)(0) = x_i(0).
        convex: whether every ψ is known to be concave.
        rounds: how many; `PATIENCE` if None.
        least: rounds before which nothing ends the run, since constraints still move.
        stop: when to end earlier: every margin positive for `HOLD` rounds (or `hopeless` and settled); settled, or `enough`; or never.
        faults: loss and sleep; none if None.
        body: how fast positions follow estimates; at once if None.
        record: whether to keep all estimates; if None, while they are few.
        choice: what to record; if None, what the size of the team suggests.
        sink: where to; in memory if None.
        checkpoint: where to keep the state, and what to take up; nowhere and nothing if None.
        hopeless: says of (N, d) positions whether they prove that no formation satisfies every constraint.
        enough: says of (N, d) positions whether no formation is better by more than a tolerance.
        then: the layout to which the team goes over where that of `copies` has not satisfied it in time, see `TURN`; None if it has none.
        events: whether agents send only what is news, see `consat.protocols.sending`.
        progress: called with the fraction done (of the longest possible run) and the margin.
    """
    faults = faults or Faults()
    choice = choice or Choice.of(team, copies, estimates=record)
    most, turn = HOLD, None
    engine: Engine
    if jax.process_count() > 1:
        from consat.engine.cluster import ManyProcesses

        hold = HOLD if stop == "satisfied" else None
        engine = ManyProcesses(team, protocol, copies, nu, size, first, convex=convex, faults=faults, body=body, choice=choice, hold=hold)
    else:
        live = Live.of(team, 0.0 if body is None else 1.0 / body.rate, all_of_them=False)
        how: Any = {"convex": convex, "faults": faults, "body": body, "speaks": protocol.speaks, "events": events}
        world = world_of(team, copies, nu, size, live=live, **how)
        most = longest_hold(protocol, world)
        ends = (HOLD, most) if stop == "satisfied" else None
        engine = OneProcess(protocol, world, first, faults.seed, choice, ends, knowing=ENOUGH[stop])
        if then is not None:
            other = functools.partial(world_of, team, then, nu, size, **how)
            turn = Turn(lambda first: OneProcess(
                protocol, other(), first, later(faults.seed), _over(choice, copies, then), ends, knowing=ENOUGH[stop]
            ), copies, then)  # fmt: skip
    rules = Rules(
        end=least + PATIENCE if rounds is None else rounds, least=least, stop=stop, most=most, still=stillness(size.length, enough),
        earliest=protocol.earliest(engine.world.everyone),
        hopeless=hopeless, enough=enough, turn=None if turn is None else turn_after(engine.world),
    )  # fmt: skip
    how_run = (protocol, nu, size, first, faults, body, copies.layout, convex, *["events"] * events)
    problem = "" if checkpoint is None else fingerprint(team, *how_run)
    course = _Course(team, engine, rules, choice, body, turn)
    if turn is not None and checkpoint is not None and checkpoint.turned:
        course.turn(np.zeros((turn.after.count, team.dimension)))
    return follow(course, copies, choice, sink=sink or Memory(choice.every), checkpoint=checkpoint, problem=problem, progress=progress)


class Turn(NamedTuple):
    """How a run goes over to another layout of copies.

    Attributes:
        engine: who carries it out from then on, from first estimates.
        before: the layout until then.
        after: the layout from then on.
    """

    engine: Callable[[np.ndarray], OneProcess]
    before: Estimates
    after: Estimates


def turn_after(world: World) -> int:
    """The round after which a team that is not satisfied over its links goes over to a spanning tree."""
    return TURN + TURN_HOP * world.everyone.hops


def later(seed: int) -> int:
    """The seed of what goes wrong from then on."""
    return seed ^ 1


def _over(choice: Choice, before: Estimates, after: Estimates) -> Choice:
    """What is recorded from then on: the same copies, and of one that its holder no longer has the position that it was of."""
    if choice.copies is None:
        return choice
    position = before.position[choice.copies]
    rows, found = after.found(before.holder[choice.copies], position)
    return dataclasses.replace(choice, copies=np.where(found, rows, after.own[position]))


@dataclass(frozen=True)
class Rules:
    """When a run ends; see `simulate_rounds`.

    Attributes:
        end: rounds at most.
        least: rounds at least.
        stop: when to end earlier.
        most: how many satisfied rounds on end are the end, whether all know it or not.
        still: a chunk in which no position moved farther is one in which the team stood still, length.
        earliest: the round before which to stand still means nothing.
        hopeless: see `simulate_rounds`.
        enough: see `simulate_rounds`.
        turn: the round after which a team that is not satisfied goes over to another layout; None if it has none.
    """

    end: int
    stop: Stop
    still: float
    most: int = HOLD
    least: int = 0
    earliest: int = 0
    hopeless: Callable[[np.ndarray], bool] = lambda _: False
    enough: Callable[[np.ndarray], bool] | None = None
    turn: int | None = None

    def turns(self, tally: Tally) -> bool:
        """Whether the team goes over to another layout now: the one that it has is not known to get anywhere."""
        return self.turn is not None and tally.turned is None and tally.done >= self.turn and tally.streak == 0

    def chunk(self, tally: Tally) -> int:
        """How many rounds to go before the next look."""
        looks = [at for at in (self.turn, self.least, self.end) if at is not None and at > tally.done]
        return min(CHUNK, min(looks, default=tally.done) - tally.done)

    def ending(self, tally: Tally, positions: Callable[[], np.ndarray]) -> Ending | None:
        """Why the run should end now, or None."""
        if np.isnan(tally.drift) or (tally.drift == np.inf and not np.isfinite(positions()).all()):
            return "diverged"
        if self.stop == "never" or tally.done < self.least:
            return None
        if self.stop == "satisfied" and tally.streak >= HOLD and (tally.known & SATISFIED or tally.streak >= self.most):
            return "satisfied"
        if tally.near >= SURE:
            return "settled"
        if self.stop == "converged" and self.enough is not None and self.enough(positions()):
            return "settled"
        if tally.done - (tally.turned or 0) < self.earliest or tally.drift > self.still:
            return None
        if self.stop == "converged":
            return "settled"
        if tally.done < PATIENT * tally.asked:
            return None
        tally.asked = tally.done
        return "settled" if self.hopeless(positions()) else None


class _Course:
    """Rounds, for `consat.engine.loop`.

    Args:
        team: who runs.
        engine: who carries them out.
        rules: when they end.
        choice: what is recorded.
        body: see `simulate_rounds`.
        turn: see there; None if there is none.
    """

    def __init__(self, team: Team, engine: Engine, rules: Rules, choice: Choice, body: Body | None, turn: Turn | None) -> None:
        self._turn = turn
        self._team, self._engine, self._rules, self._choice = team, engine, rules, choice
        self._period = None if body is None else 1.0 / body.rate
        self.tally, self.end = Tally(every=choice.every), rules.end

    def start(self) -> tuple[Any, Rows]:
        state, chunk = self._engine.start()
        self._last = state
        return state, self._count(chunk, 1)

    def advance(self, state: Any, every: int) -> tuple[Any, Rows, Ending | None]:
        done = self.tally.done
        streak = (self.tally.streak, self.tally.near) if done >= self._rules.least else None
        state, chunk = self._engine.advance(state, done, self._rules.chunk(self.tally), streak, every)
        self._last = state
        rows = self._count(chunk, every)
        ending = self._rules.ending(self.tally, functools.partial(self.positions, state))
        if ending is None and self._turn is not None and self._rules.turns(self.tally):
            self.turn(self._turn.after.carried(self._turn.before, np.asarray(state.state.x), self.positions(state)))
            state, _ = self._engine.start()
            self.tally.turned, self.tally.near = self.tally.done, 0
        return state, rows, ending

    def turn(self, first: np.ndarray) -> None:
        """Go over to the other layout, from first estimates, (C, d)."""
        assert self._turn is not None, "of a team that has one"
        self._engine = self._turn.engine(first)

    def agree(self, stop: bool) -> bool:
        return self._engine.agree(stop)

    def positions(self, state: Any) -> np.ndarray:
        return self._engine.positions(state)

    def _count(self, chunk: Chunk, every: int) -> Rows:
        numbers = self.tally.add(chunk)
        chosen = np.flatnonzero(numbers % every == 0)
        kept = Kept(*(np.asarray(leaf)[: len(chosen)] for leaf in chunk.kept))
        margins = [np.asarray(leaf)[chosen] for leaf in (chunk.margin, chunk.smooth_margin, chunk.bound)]
        return self._rows(numbers[chosen], margins, kept)

    def look(self, state: Any) -> Rows:
        tally = self.tally
        margins = [np.array([number]) for number in (tally.margin, tally.smooth_margin, tally.bound)]
        return self._rows(np.array([tally.done]), margins, Kept(*(leaf[None] for leaf in self._engine.look(state, tally.done))))

    def _rows(self, step: np.ndarray, margins: Sequence[np.ndarray], kept: Kept) -> Rows:
        margin, smooth_margin, bound = margins
        estimate = None if self._choice.copies is None else kept.estimate
        heading = kept.heading if self._engine.world.drive is not None else None
        return Rows(step, kept.position, None, margin, smooth_margin, kept.agent_margin, estimate, None, bound, heading)

    def told(self, rows: Rows) -> Mapping[str, Any]:
        tally = self.tally
        return {
            "clock": "round",
            "velocity": velocities(rows.step, rows.position, 1.0 if self._period is None else self._period),
            "satisfied_from": float(tally.last_bad + 1) if tally.last_bad < tally.done else None,
            "messages": tally.messages,
            "floats_sent": tally.floats,
            "bytes": tally.bytes,
            **_known(tally),
            "turned": tally.turned,
            "period": self._period,
            "heading": rows.heading,
            "motion": None if self._period is None else tally.motion(self._period) | driven(self._team, self._engine.world, self._last),
            "violated": None if tally.violated is None else shares(self._team, tally.violated, tally.done + 1),
        }


def known_of(tally: Tally) -> Literal["satisfied", "infeasible"] | None:
    """What all agents know."""
    return "satisfied" if tally.known & SATISFIED else "infeasible" if tally.known & INFEASIBLE else None


def driven(team: Team, world: World, now: Now) -> dict[str, Any]:
    """Of ``run --json`` what is said of robots: distances, m, contacts, who is stuck, and which conditions for that nobody
    touches did not hold."""
    if world.drive is None or now.robots is None:
        none = {"smallest_distance": None, "clearance": None, "simulator": None}
        return none | {"contacts": 0, "collisions": 0, "stuck": [], "unproven": []}
    drive, robots = world.drive, now.robots
    report, stuck = _ended()(drive, robots.state, robots.memory, now.state.x[world.own])
    noise, wind = (0.0 if leaf is None else float(np.linalg.norm(leaf)) for leaf in (world.noise, world.wind))
    gap, clear = float(report.smallest_distance), float(report.clearance)
    return {
        "smallest_distance": gap if np.isfinite(gap) else None,
        "clearance": clear if np.isfinite(clear) else None,
        "contacts": int(report.contacts),
        "collisions": int(report.collisions),
        "stuck": [team.ids[i] for i in np.flatnonzero(stuck).tolist()],
        "unproven": list(conditions(drive, noise=noise, wind=wind, report=report)),
        "simulator": drive.model.name if isinstance(drive.model, Simulated) else None,
    }


@functools.cache
def _ended() -> Callable[..., tuple[Report, Array]]:
    """`Drive.ended` as one program: op by op it is sixty."""
    return jax.jit(Drive.ended, static_argnums=0, compiler_options=quick_compilation())


def _known(tally: Tally) -> Mapping[str, Any]:
    """What all agents know at the end, and since when. They judge by estimates: what does not hold at their positions is not known."""
    if tally.known & SATISFIED and tally.last_bad < tally.done:
        return {"known": "satisfied", "known_from": max(tally.last_unknown, tally.last_bad) + 1}
    if tally.known & INFEASIBLE:
        return {"known": "infeasible", "known_from": tally.infeasible_from}
    return {"known": None, "known_from": None}
