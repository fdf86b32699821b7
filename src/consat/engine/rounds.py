"""Run of a protocol in rounds: computed by an engine, counted by `tally`, ended by `rules`, recorded by `loop`."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np

from consat.engine.bodies import Body
from consat.engine.checkpoint import Checkpoint, fingerprint
from consat.engine.chunks import Engine, OneProcess
from consat.engine.live import Live
from consat.engine.loop import follow
from consat.engine.recording import Choice, Memory, Rows, Sink
from consat.engine.rules import ENOUGH, HOLD, PATIENCE, Rules, longest_hold, stillness, turn_after
from consat.engine.simulation import RoundsSimulation
from consat.engine.world import world_of
from consat.faults import Faults
from consat.numerics import float64
from consat.problem.objective import Nu
from consat.problem.team import Team
from consat.problem.units import Scale
from consat.protocols import Rounds
from consat.protocols.estimates import Estimates
from consat.results.trace import Ending, Trace
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
    simulation = _Run(team, engine, choice, body, rules, turn)
    if turn is not None and checkpoint is not None and checkpoint.turned:
        simulation.turn(np.zeros((turn.after.count, team.dimension)))
    return follow(simulation, copies, choice, sink=sink or Memory(choice.every), checkpoint=checkpoint, problem=problem, progress=progress)


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


class _Run(RoundsSimulation):
    """A simulation in rounds that its rules end. Arguments as in `simulate_rounds`."""

    def __init__(self, team: Team, engine: Engine, choice: Choice, body: Body | None, rules: Rules, turn: Turn | None) -> None:
        super().__init__(team, engine, choice, None if body is None else 1.0 / body.rate)
        self._rules, self._turn = rules, turn
        self.end = rules.end

    def advance(self, every: int) -> tuple[Rows, Ending | None]:
        tally = self.tally
        streak = (tally.streak, tally.near) if tally.done >= self._rules.least else None
        rows = self.go(self._rules.chunk(tally), every, streak=streak)
        ending = self._rules.ending(tally, self.positions)
        if ending is None and self._turn is not None and self._rules.turns(tally):
            self.turn(self._turn.after.carried(self._turn.before, np.asarray(self.state.state.x), self.positions()))
            self.state, _ = self.engine.start()
            tally.turned, tally.near = tally.done, 0
        return rows, ending

    def turn(self, first: np.ndarray) -> None:
        """Switch to the other layout. `first`: (C, d) initial estimates."""
        assert self._turn is not None
        self.engine = self._turn.engine(first)
