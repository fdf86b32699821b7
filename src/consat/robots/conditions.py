"""Check of the conditions of the theorem in docs/robots.md."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from consat.numerics import float64
from consat.robots.drive import Drive, Report
from consat.robots.obstacles import overlaps


@float64
def conditions(
    drive: Drive, state: Any = None, *, noise: float = 0.0, wind: float = 0.0, paused: float = 0.0, report: Report | None = None
) -> tuple[str, ...]:
    """The conditions of the theorem that do not hold, one sentence each. If the tuple is empty, no bodies can touch.

    Args:
        drive: the robot layer.
        state: state of the robots at the start. None skips these checks, for robots that began at rest: the report has their overlaps.
        noise: largest error of a measured position, m.
        wind: speed of the air, m/s.
        paused: longest time that a command was held beyond `drive.dt`, s.
        report: report of a run; None before a run.
    """
    model, count, dt = drive.model, drive.count, drive.dt
    broken = []
    if noise > drive.noise:
        broken.append(f"noise: positions are measured to {noise:g} m, but the filter allows for {drive.noise:g} m")
    if drive.noise > 0.0 and model.inertial:
        broken.append("noise: for robots that cannot halt at once, nothing is proven where positions are measured with noise")
    if paused > 0.0:
        broken.append(f"sampling: a command was held {dt + paused:g} s, but the filter allows for {dt:g} s")
    if wind > 0.0 and _drifts(drive, wind):
        broken.append(f"wind: {wind:g} m/s moves robots by what no command asked for")
    pace, size = np.asarray(model.pace(count)), drive.size
    least = float(2.0 * size.max() + 2.0 * pace.max() * dt + 2.0 * np.max(np.asarray(model.halting(count, dt))) + 2.0 * drive.noise)
    if drive.sensing is not None and drive.sensing < least:
        broken.append(f"sensing: the range is {drive.sensing:g} m, but must be {least:.4g} m")
    if state is not None:
        place = model.place(state)
        if model.inertial and bool(jnp.any(jnp.linalg.norm(model.stop(state, dt) - place, axis=1) > 0.0)):
            broken.append("start: robots must be at rest")
        touching = _overlaps(drive, np.asarray(place))
        if touching:
            broken.append(f"start: {touching}")
    return tuple(broken) + (() if report is None else tuple(_told(report)))


def _told(report: Report) -> Iterator[str]:
    """Sentences for the conditions that did not hold, by the report of a run."""
    if float(report.overlap) > 0.0:
        yield (
            f"distance: robots, or one and an obstacle, were {float(report.overlap):.3g} m nearer to each other than the filter keeps, "
            "at the start or after something else went wrong"
        )
    if float(report.strayed) > 0.0:
        yield f"tube: a body was {float(report.strayed):.3g} m farther from its reference than the filter allows for"


def _drifts(drive: Drive, wind: float) -> bool:
    """Whether wind moves the places that the filter keeps apart, in one step of robots at rest."""
    state = drive.model.start(jnp.zeros((drive.count, drive.dimension)))
    still = drive.model.halt(state, drive.dt)
    air = jnp.full((drive.count, drive.dimension), wind)
    after = jax.block_until_ready(drive.model.step(state, still, drive.dt, air))
    return bool(jnp.any(drive.model.place(after) != drive.model.place(state)))


def _overlaps(drive: Drive, place: np.ndarray) -> str | None:
    """Text about the first robot that is nearer to another, or to an obstacle, than the filter keeps; None if there is none."""
    size = np.asarray(drive.model.size(drive.count, drive.dt))
    for first, second, distance in overlaps(place, size):
        nearer = size[first] + size[second] - distance
        return f"robots {first} and {second} are {nearer:.3g} m nearer to each other than the filter keeps"
    clear = np.asarray(drive.map.signed_distance(jnp.asarray(place))) - size
    if clear.min(initial=np.inf) < 0.0:
        return f"robot {int(np.argmin(clear))} is {-clear.min():.3g} m nearer to an obstacle than the filter keeps"
    return None
