"""Protocols in rounds: the outer loop, what is recorded of it, and when it ends."""

from __future__ import annotations

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from consat.estimates import Estimates
from consat.numerics import CompileClock, float64, quick_compilation
from consat.objective import Nu
from consat.protocols import Rounds
from consat.simulate import Stop
from consat.simulate.kernel import Body, Now, Seen, Weather, begin, many_rounds, world_of
from consat.team import Team
from consat.trace import Ending, Trace, satisfied_from

HOLD = 10
"""How many rounds on end every margin must stay positive before a team counts as satisfied."""
PATIENCE = 2000
"""How many rounds a team may take when nobody says."""
CHUNK = 10
"""Rounds between two looks at the stop rule and the progress bar."""
MOST_NUMBERS = 1000
"""Estimates are recorded by default while there are at most this many numbers."""
SETTLED = 1e-5
"""A team has settled when over `HOLD` rounds no position moved by more than this fraction of the team's unit of length."""


@functools.cache
def _compiled() -> tuple[Callable[..., tuple[Now, Seen]], Callable[..., tuple[Now, Seen]]]:
    options = quick_compilation()
    return (
        jax.jit(begin, static_argnames=("protocol",), compiler_options=options),
        jax.jit(many_rounds, static_argnames=("protocol", "look"), compiler_options=options),
    )


def _everything(seen: Seen) -> Seen:
    return seen


def _no_estimates(seen: Seen) -> Seen:
    return seen._replace(estimate=seen.estimate[:0])


@float64
def simulate_rounds(
    team: Team,
    protocol: Rounds,
    copies: Estimates,
    nu: Nu,
    length: float,
    first: np.ndarray,
    *,
    convex: bool,
    rounds: int | None = None,
    stop: Stop = "satisfied",
    weather: Weather | None = None,
    body: Body | None = None,
    record: bool | None = None,
    hopeless: Callable[[np.ndarray], bool] = lambda _: False,
    enough: Callable[[np.ndarray], bool] | None = None,
    progress: Callable[[float, float], None] = lambda *_: None,
) -> Trace:
    """Run a protocol in rounds.

    Args:
        team: whose clusters are connected.
        protocol: what they do.
        copies: the layout of estimates.
        nu: the smoothing.
        length: the team's unit of length.
        first: (C, d) first estimates, with x_i^(i)(0) = x_i(0).
        convex: whether every ψ is known to be concave.
        rounds: how many; `PATIENCE` if None.
        stop: when to end earlier: every margin positive for `HOLD` rounds (or `hopeless` and settled); settled, or `enough`; or never.
        weather: loss and sleep; none if None.
        body: how fast positions follow estimates; at once if None.
        record: whether to keep all estimates; if None, while they are few.
        hopeless: says of (N, d) positions whether they prove that no formation satisfies every constraint.
        enough: says of (N, d) positions whether no formation is better by more than a tolerance.
        progress: called with the fraction done (of the longest possible run) and the margin.
    """
    weather = weather or Weather()
    end = PATIENCE if rounds is None else rounds
    world = world_of(team, copies, nu, length, convex=convex, weather=weather, body=body)
    recorded = copies.count * team.dimension <= MOST_NUMBERS if record is None else record
    look = _everything if recorded else _no_estimates
    seen: list[Seen] = []
    ending: Ending = "out of time"
    done = 0
    start, go_on = _compiled()
    with CompileClock() as clock:
        now, looked = start(protocol, world, jnp.asarray(first), jax.random.key(weather.seed))
        seen.append(jax.tree.map(lambda leaf: np.asarray(leaf)[None], look(looked)))
        try:
            while done < end:
                count = min(CHUNK, end - done)
                now, looked = go_on(protocol, world, now, jnp.arange(done, done + count, dtype=float), look)
                seen.append(jax.tree.map(np.asarray, looked))
                done += count
                progress(done / end, float(seen[-1].margin[-1]))
                settle = done >= protocol.earliest(world.everyone)
                if (found := _ending(seen, stop, length, settle, hopeless, enough)) is not None:
                    ending = found
                    break
        except KeyboardInterrupt:
            ending = "interrupted"
    whole = Seen(*(np.concatenate([getattr(part, name) for part in seen]) for name in Seen._fields))
    if stop == "satisfied" and ending == "satisfied":
        whole = Seen(*(leaf[: _satisfied_at(whole.margin) + 1] for leaf in whole))
    return _trace(whole, copies, ending, body, clock.seconds, recorded=recorded)


def _satisfied_at(margin: np.ndarray) -> int:
    """The round at which every margin was positive for `HOLD` rounds on end, or −1."""
    good = np.concatenate([[0], np.cumsum(margin > 0)])
    whole = np.flatnonzero(good[HOLD:] - good[:-HOLD] == HOLD)
    return int(whole[0]) + HOLD - 1 if len(whole) else -1


def _for_good(known: np.ndarray) -> int | None:
    """The round from which on everybody knew, or None."""
    unknown = np.flatnonzero(~known)
    since = int(unknown[-1]) + 1 if len(unknown) else 0
    return since if since < len(known) else None


def _ending(
    seen: list[Seen], stop: Stop, length: float, settle: bool, hopeless: Callable[[np.ndarray], bool],
    enough: Callable[[np.ndarray], bool] | None,
) -> Ending | None:  # fmt: skip
    last = seen[-1]
    if not np.isfinite(last.position).all():
        return "diverged"
    if stop == "never":
        return None
    if stop == "satisfied" and _satisfied_at(np.concatenate([part.margin for part in seen[-3:]])) >= 0:
        return "satisfied"
    if stop == "converged" and enough is not None and enough(last.position[-1]):
        return "settled"
    position = np.concatenate([part.position for part in seen[-3:]])[-HOLD:]
    settled = settle and len(position) == HOLD and np.abs(position - position[-1]).max(initial=0.0) <= SETTLED * length
    return "settled" if settled and (stop == "converged" or hopeless(position[-1])) else None


def _trace(seen: Seen, copies: Estimates, ending: Ending, body: Body | None, seconds: dict[str, float], *, recorded: bool) -> Trace:
    steps = np.arange(len(seen.margin))
    dt = 1.0 if body is None else 1.0 / body.rate
    velocity = np.diff(seen.position, axis=0, append=seen.position[-1:]) / dt
    return Trace(
        clock="round",
        steps=steps,
        position=seen.position,
        velocity=velocity,
        margin=seen.margin,
        smooth_margin=seen.smooth_margin,
        agent_margin=seen.agent_margin,
        estimate=seen.estimate if recorded else None,
        integral=None,
        holder=copies.holder,
        held=copies.position,
        cluster=copies.cluster,
        ending=ending,
        satisfied_from=satisfied_from(steps, seen.margin, interpolate=False),
        messages=int(seen.messages.sum()),
        floats_sent=int(seen.floats.sum()),
        known_from=_for_good(seen.known),
        seconds=seconds,
        period=None if body is None else dt,
    )
