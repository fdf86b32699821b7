"""One control step of a team of robots: from targets to commands, new states, and a report of distances.

The command of a robot depends on its own state and target, the public map, and what it measures of its neighbours. The arrays hold all
robots only to compute them together. `Drive.step` can be traced. Paths around obstacles are planned elsewhere, see `planning`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from consat.errors import Fault, InvalidInput
from consat.numerics import float64
from consat.robots import deadlock
from consat.robots import filter as safety
from consat.robots.deadlock import Rules
from consat.robots.model import LARGEST, Model, along, each, squared
from consat.robots.neighbours import Candidates, Near, candidates, near
from consat.robots.obstacles import Map, map_of
from consat.robots.simulated import Simulated

PAIRS_COUNTED = 4000
"""Most robots for which each pair that touched is remembered. With more robots, touches are only counted."""
PATIENCE = 5.0
"""Time without progress towards its target after which a robot that has not arrived counts as stuck, s."""


class Memory(NamedTuple):
    """State that is carried from step to step. Each robot has its own, except `known`, which only saves time, `touched` and `report`.

    Attributes:
        velocity: (N, d) velocities that others measured last, m/s.
        blocked: (N,) angle by which each robot turns its wished velocity, in right angles.
        waypoint: (N,) index of the next waypoint on each path.
        goal: (N, d) the target that `least` is about.
        least: (N,) shortest remaining path length so far, m.
        waited: (N,) time since it last became shorter, s.
        known: candidates for the nearest neighbours.
        touched: (N, N) whether a pair ever touched; (0, 0) if touches are only counted.
        report: report of the steps so far.
    """

    velocity: Array
    blocked: Array
    waypoint: Array
    goal: Array
    least: Array
    waited: Array
    known: Candidates
    touched: Array
    report: Report


class Report(NamedTuple):
    """Report of all steps so far. Entries without a shape are scalars.

    Attributes:
        smallest_distance: smallest distance between the surfaces of two bodies in range of each other, m; infinite if there were none.
        clearance: smallest distance from the surface of a body to an obstacle, m; infinite without obstacles.
        contacts: number of pairs that touched; with more than `PAIRS_COUNTED` robots, of touches.
        collisions: number of robots in contact with an obstacle, summed over the steps.
        halted: (N,) number of steps in which the filter halted each robot.
        strayed: largest distance of a body from its reference, beyond what the filter allows for, m.
        overlap: largest violation of the distance that the filter keeps between robots, or to obstacles, m.
    """

    smallest_distance: Array
    clearance: Array
    contacts: Array
    collisions: Array
    halted: Array
    strayed: Array
    overlap: Array


@dataclass(frozen=True, eq=False)
class Drive:
    """The robot layer of a team.

    Args:
        model: a model, or a `Fleet` of several.
        count: number of robots, N.
        dimension: dimension of space, d.
        dt: time between two commands, s.
        obstacles: public map.
        noise: largest error of a measured position, m. Kept distances grow with it.
        share: fraction of a gap that may be used up in one step, in (0, 1].
        neighbours: largest number of neighbours with a plane of their own. The others only limit the speed.
        parts: largest number of parts of obstacles with a plane of their own.
        sensing: range of the sensors, m; None for the range that `rules` need.
        rules: parameters of the rules against deadlock.

    Attributes:
        map: the obstacles as arrays.
        size: (N,) radius that each robot keeps free around its place, m.
        range: distance up to which each robot sees others, m.
        explained: largest apparent overlap that noise alone can explain, m.

    Raises:
        InvalidInput: a setting or an obstacle cannot be used.
    """

    model: Model[Any]
    count: int
    dimension: int
    dt: float
    obstacles: Sequence[Any] = ()
    noise: float = 0.0
    share: float = 1.0
    neighbours: int = 8
    parts: int = 4
    sensing: float | None = None
    rules: Rules = field(default_factory=Rules)
    map: Map = field(init=False)
    size: np.ndarray = field(init=False)
    range: float = field(init=False)
    explained: float = field(init=False)

    def __post_init__(self) -> None:
        faults = []
        kind = type(self.model).__name__.lower()
        if self.dimension not in self.model.dimensions:
            allowed = " or ".join(map(str, self.model.dimensions))
            faults.append(Fault(("robots", "kind"), f"{kind} robots move in {allowed} dimensions, but the team has {self.dimension}"))
        for name, value, fits, allowed in (
            ("dt", self.dt, self.dt > 0.0, "positive"),
            ("share", self.share, 0.0 < self.share <= 1.0, "above 0 and at most 1"),
            ("noise", self.noise, self.noise >= 0.0, "0 or more"),
        ):
            if not (math.isfinite(value) and fits):
                faults.append(Fault(("robots", name), f"must be {allowed}, but is {value:g}"))
        if faults:
            raise InvalidInput(faults)
        for name, value in {"map": map_of(self.obstacles, self.dimension), **_sizes(self)}.items():
            object.__setattr__(self, name, value)

    @property
    def arrives(self) -> Array:
        """(N,) distance from its target at which each robot has arrived, m: its radius."""
        return each(self.model.radius, self.count)

    def start(self, state: Any) -> Memory:
        """The memory at the start. Its types are those after a step, because a weak type would cause a second compilation."""
        place = self.model.place(state)
        zeros, never = jnp.zeros(self.count), jnp.full(self.count, jnp.inf, dtype=jnp.float64)
        pairs = self.count if self.count <= PAIRS_COUNTED else 0
        nothing, none = jnp.full((), jnp.inf, dtype=jnp.float64), jnp.zeros((), dtype=jnp.int64)
        report = Report(nothing, nothing, none, none, jnp.zeros(self.count, dtype=jnp.int64), jnp.zeros(()), jnp.zeros(()))
        return Memory(
            jnp.zeros_like(place),
            zeros,
            jnp.zeros(self.count, dtype=jnp.int64),
            jnp.full_like(place, LARGEST),
            never,
            zeros,
            candidates(place),
            jnp.zeros((pairs, pairs), dtype=bool),
            report,
        )

    def step(
        self,
        state: Any,
        memory: Memory,
        targets: Array,
        *,
        paths: Array | None = None,
        measured: Array | None = None,
        wind: Array | None = None,
    ) -> tuple[Any, Memory, Array]:
        """Advance by one step of `dt`.

        Args:
            state: of the model.
            memory: from the last step, or `start`.
            targets: (N, d) where each wants to be.
            paths: (N, W, d) waypoints, the last of which are the targets; None to go straight.
            measured: (N, d) measured positions, wrong by at most `noise`; None for the true ones.
            wind: (N, d) velocity of the air; None for none.

        Returns:
            state and memory after the step, and the command, (N, m).
        """
        model, dt, size = self.model, self.dt, jnp.asarray(self.size)
        true = model.place(state)
        place = true if measured is None else measured
        stop = place + (model.stop(state, self.dt) - true) if model.inertial else None
        top = model.pace(self.count)
        known, around = near(memory.known, place, self.neighbours, self.range)
        memory = self._looked_at(state, memory, around)
        planes = safety.neighbour_planes(place, stop, size, around, self.share, explained=self.explained)
        everything = planes
        if self.map.count:
            walls = safety.obstacle_planes(place, stop, size, self.map, self.parts, share=self.share, explained=self.explained)
            everything = safety.joined(planes, walls)
        if measured is not None:  # a robot moves by what it measures of itself
            everything = everything._replace(least=everything.least + along(everything.normals, true - place))

        waypoint, ahead, left = self._way(memory.waypoint, place, targets, paths)
        underway = jnp.linalg.norm(targets - place, axis=1) >= self.arrives
        pace = model.approach(left, dt)
        seen = deadlock.sight(planes, place, size, memory.velocity, underway, around)
        wish = deadlock.bent(self.rules, ahead, pace, top, underway=underway, blocked=memory.blocked, seen=seen)
        command, moves, straight = safety.steered(model, state, wish, ahead * pace[:, None], everything, dt)
        blocked = deadlock.refused(self.rules, memory.blocked, ahead, pace, straight, underway=underway, dt=dt)
        after = model.step(state, command, dt, wind)

        anew = jnp.linalg.norm(targets - memory.goal, axis=1) > self.arrives
        nearer = left < memory.least - 0.1 * self.arrives
        memory = memory._replace(
            velocity=model.velocity(state, command),
            blocked=blocked,
            waypoint=waypoint,
            goal=jnp.where(anew[:, None], targets, memory.goal),
            least=jnp.where(anew | nearer, left, memory.least),
            waited=jnp.where(anew | nearer | ~underway, 0.0, memory.waited + dt),
            known=known,
            report=memory.report._replace(halted=memory.report.halted + (~moves).astype(jnp.int64)),
        )
        return after, memory, command

    def observed(self, state: Any, memory: Memory) -> Memory:
        """The memory with the present state in its report. Without this call, the report ends where the last step began."""
        known, around = near(memory.known, self.model.place(state), self.neighbours, self.range)
        return self._looked_at(state, memory._replace(known=known), around)

    def ended(self, state: Any, memory: Memory, targets: Array) -> tuple[Report, Array]:
        """The report with the present state, and (N,) who is stuck; can be traced."""
        return self.observed(state, memory).report, ~self.arrived(state, targets) & (memory.waited > PATIENCE)

    def stuck(self, state: Any, memory: Memory, targets: Array) -> list[int]:
        """Indices of robots that have not arrived and made no progress for `PATIENCE`."""
        return np.flatnonzero(np.asarray(self.ended(state, memory, targets)[1])).tolist()

    def arrived(self, state: Any, targets: Array) -> Array:
        """(N,) whether each robot is at its target; see `arrives`."""
        return jnp.linalg.norm(targets - self.position(state), axis=1) < self.arrives

    def position(self, state: Any) -> Array:
        """(N, d) points that constraints read: the places of the model, or those that a simulator measures."""
        return self.model.position(state) if isinstance(self.model, Simulated) else self.model.place(state)

    def _way(self, waypoint: Array, place: Array, targets: Array, paths: Array | None) -> tuple[Array, Array, Array]:
        """The next waypoint (N,), the unit vector to it (N, d), and the length of the way that is left (N,), m.

        A waypoint is passed where its own distance is less than the body's size, or where the robot is beyond it, seen along what follows.
        """
        if paths is None:
            target, rest = targets, jnp.zeros(self.count)
        else:
            last = paths.shape[1] - 1
            size = jnp.asarray(self.size)
            legs = jnp.linalg.norm(jnp.diff(paths, axis=1), axis=2)
            rests = jnp.concatenate([jnp.cumsum(legs[:, ::-1], axis=1)[:, ::-1], jnp.zeros((self.count, 1))], axis=1)
            here, next_ = _row(paths, waypoint), _row(paths, jnp.minimum(waypoint + 1, last))
            distance = jnp.linalg.norm(here - place, axis=1)
            beyond = jnp.sum((next_ - here) * (place - here), axis=1) > 0.0
            passed = (distance < 0.5 * size) | (beyond & (distance < 3.0 * size))
            waypoint = jnp.minimum(waypoint + passed.astype(waypoint.dtype), last)
            target, rest = _row(paths, waypoint), _row(rests, waypoint)
        way = target - place
        length = jnp.linalg.norm(way, axis=1)
        return waypoint, way / jnp.maximum(length, 1e-9)[:, None], length + rest

    def _looked_at(self, state: Any, memory: Memory, around: Near) -> Memory:
        """The report with the present bodies, given the nearest neighbours."""
        body, place = self.model.body(state), self.model.place(state)
        radius, kept, report = each(self.model.radius, self.count), self.model.size(self.count, self.dt), memory.report
        there, index = around.who < self.count, jnp.minimum(around.who, self.count - 1)
        within = kept[:, None] + kept[index] - jnp.sqrt(squared(place[:, None] - place[index]))
        gap = jnp.where(there, jnp.sqrt(squared(body[:, None] - body[index])) - radius[:, None] - radius[index], jnp.inf)
        report = report._replace(
            smallest_distance=jnp.minimum(report.smallest_distance, jnp.min(gap, initial=jnp.inf)),
            strayed=jnp.maximum(report.strayed, jnp.max(jnp.linalg.norm(body - place, axis=1) + radius - kept)),
            overlap=jnp.maximum(report.overlap, jnp.max(jnp.where(there, within, 0.0), initial=0.0)),
        )
        if self.map.count:
            clear = self.map.signed_distance(body) - radius
            struck = 0 if isinstance(self.model, Simulated) else jnp.sum(clear < 0.0)
            report = report._replace(
                clearance=jnp.minimum(report.clearance, jnp.min(clear)),
                collisions=report.collisions + struck,
                overlap=jnp.maximum(report.overlap, jnp.max(kept - self.map.signed_distance(place))),
            )
        if isinstance(self.model, Simulated):  # contacts are the simulator's
            bodies = state.bodies
            touched = memory.touched | bodies.touching if len(memory.touched) else memory.touched
            contacts = jnp.sum(touched) if len(memory.touched) else report.contacts + jnp.sum(bodies.touching)
            report = report._replace(contacts=contacts, collisions=report.collisions + jnp.sum(bodies.struck))
            return memory._replace(touched=touched, report=report)
        touching = gap < 0.0
        rows = jnp.broadcast_to(jnp.arange(self.count, dtype=index.dtype)[:, None], index.shape)

        def counted(before: tuple[Array, Array]) -> tuple[Array, Array]:
            if not len(memory.touched):
                return before[0], before[1] + jnp.sum(touching) // 2
            touched = before[0].at[jnp.minimum(rows, index), jnp.maximum(rows, index)].max(touching)
            return touched, jnp.sum(touched)

        touched, contacts = jax.lax.cond(jnp.any(touching), counted, lambda before: before, (memory.touched, report.contacts))
        return memory._replace(touched=touched, report=report._replace(contacts=contacts))


@float64
def _sizes(drive: Drive) -> dict[str, Any]:
    """`size`, `range` and `explained`."""
    model, count, dt = drive.model, drive.count, drive.dt
    with jax.ensure_compile_time_eval():
        added = safety.margin(model, count, dt, drive.noise, drive.share)
        size, pace, halting = (np.asarray(value) for value in (model.size(count, dt), model.pace(count), model.halting(count, dt)))
    needed = 2.0 * (size + added).max() + pace.max() * max(2.0 * drive.rules.reach, 4.0 * dt) + 2.0 * halting.max()
    return {"size": size + added, "range": float(needed if drive.sensing is None else drive.sensing), "explained": 4.0 * added}


def _row(rows: Array, index: Array) -> Array:
    """(N, W, …) and (N,) → (N, …)."""
    return rows[jnp.arange(len(index)), index]
