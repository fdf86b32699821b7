"""Run of a protocol in rounds: computed by an engine, counted by `tally`, ended by `rules`, recorded by `loop`."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from jax import Array

from consat.engine.bodies import Body
from consat.engine.checkpoint import Checkpoint, fingerprint
from consat.engine.chunks import Chunk, Engine, Kept, OneProcess
from consat.engine.live import Live
from consat.engine.loop import follow
from consat.engine.recording import Choice, Memory, Rows, Sink, velocities
from consat.engine.round import Now
from consat.engine.rules import ENOUGH, HOLD, PATIENCE, Rules, longest_hold, stillness, turn_after
from consat.engine.tally import Tally
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
from consat.settings import Stop


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
        team: team with connected clusters.
        protocol: the protocol.
        copies: the layout of estimates.
        nu: the smoothing.
        size: the natural scale of the team.
        first: (C, d) initial estimates; those of own positions are the initial positions.
        convex: whether every ψ is known to be concave.
        rounds: largest number of rounds; `PATIENCE` if None.
        least: number of rounds before which nothing ends the run, because constraints still move.
        stop: condition that ends the run earlier. ``satisfied``: every margin is positive for `HOLD` rounds, or the team is settled and
            `hopeless`. ``converged``: the team is settled, or its margin is `enough`.
        faults: loss and sleep; None for none.
        body: motion of the bodies; None if they are at the estimates.
        choice: what is recorded; if None, the default for the size of the team.
        sink: where to record; if None, in memory.
        checkpoint: where to save the state, and the checkpoint to resume from; None for neither.
        hopeless: see `Rules`.
        enough: see `Rules`.
        then: layout to which a team switches that `copies` has not satisfied in time, see `turn_after`; None without one.
        events: whether agents send only what is new; see `consat.protocols.sending`.
        progress: called with the fraction done (of the longest possible run) and the margin.
    """
    faults = faults or Faults()
    choice = choice or Choice.of(team, copies)
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
    """Switch to another layout of copies.

    Attributes:
        engine: returns the engine after the switch, from initial estimates, (C, d).
        before: the layout before the switch.
        after: the layout after the switch.
    """

    engine: Callable[[np.ndarray], OneProcess]
    before: Estimates
    after: Estimates


def later(seed: int) -> int:
    """Seed of the faults after a switch to another layout."""
    return seed ^ 1


def _over(choice: Choice, before: Estimates, after: Estimates) -> Choice:
    """What is recorded after a switch: the same copies. For a copy that its holder no longer has, the owner's own copy of the position."""
    if choice.copies is None:
        return choice
    position = before.position[choice.copies]
    rows, found = after.found(before.holder[choice.copies], position)
    return dataclasses.replace(choice, copies=np.where(found, rows, after.own[position]))


class _Course:
    """`consat.engine.loop.Course` in rounds; arguments as in `simulate_rounds`."""

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
        """Switch to the other layout. `first`: (C, d) initial estimates."""
        assert self._turn is not None
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
            **tally.knowledge,
            "turned": tally.turned,
            "period": self._period,
            "heading": rows.heading,
            "motion": None if self._period is None else tally.motion(self._period) | driven(self._team, self._engine.world, self._last),
            "violated": None if tally.violated is None else shares(self._team, tally.violated, tally.done + 1),
        }


def driven(team: Team, world: World, now: Now) -> dict[str, Any]:
    """Fields of the summary for robots: smallest distances, m, contacts, stuck robots, and conditions of the collision guarantee that did
    not hold."""
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
    """`Drive.ended` compiled as one program."""
    return jax.jit(Drive.ended, static_argnums=0, compiler_options=quick_compilation())
