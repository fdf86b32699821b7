"""Body of a real robot: commands of its model, filtered for collisions with measured neighbours and with obstacles of the public map.

This is the robot layer of `consat.robots` for a single robot. Measured positions of neighbours are the centres of their bodies, so that the
separating planes are between centres. After the filter of the steered point a command is therefore scaled down until the centre stays on
its side, too. Robots on a network decide at different times: a step may use half as much of a gap as where all decide at once, which leaves
room for motions that others have already started. A command is valid only for the time that the filter has checked.
"""

from __future__ import annotations

from typing import Any, Final

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from consat.errors import InvalidSettings
from consat.network.node.body import MeasuredBody, Measurement
from consat.numerics import on_device, quick_compilation
from consat.robots import Drive, Planner, Unicycle, deadlock
from consat.robots import filter as safety
from consat.robots.model import LARGEST, along
from consat.robots.neighbours import candidates, near
from consat.robots.point import Point
from consat.robots.unicycle import UnicycleState
from consat.scenario.robots import Robots, kind_of

HELD: Final = 0.2
"""Validity of a command, s, which the filter checks: twice the time between two commands."""
SHARE: Final = 0.5
"""Fraction of a gap between two robots that one step may use."""
SEEN: Final = 8
"""Largest number of neighbours with a separating plane of their own; the nearest ones are chosen."""


class RobotBody(MeasuredBody):
    """A robot whose position, heading and neighbours are measured externally.

    Args:
        robots: the model of the robot, and the map.
        dimension: d.
        timeout: time without a measurement, s, after which the position counts as unknown, and the robot is commanded to stop.

    Raises:
        InvalidSettings: the model cannot stop at once.
    """

    valid = HELD

    def __init__(self, robots: Robots, dimension: int, timeout: float) -> None:
        model = robots.common
        if not isinstance(model, Point | Unicycle):
            raise InvalidSettings(f"a {kind_of(model)} cannot halt at once; on a network point and unicycle are driven")
        # the models of the neighbours are unknown: the same model is assumed
        self._drive = drive = Drive(model, 1, dimension, HELD, robots.obstacles, share=SHARE)
        super().__init__(float(np.max(np.asarray(model.pace(1)))), timeout)
        arc = drive.size[0] - float(np.max(model.radius)) - (float(np.max(model.offset)) if isinstance(model, Unicycle) else 0.0)
        self._kept = float(np.max(model.radius) + arc)  # radius around the centre of the body, which contains its motion within a step
        self._planner = Planner(drive.map, float(drive.size[0])) if drive.map.count else None
        self._path = np.zeros((0, dimension))
        self._blocked, self._last = 0.0, 0.0
        self._steer = jax.jit(self._steered, compiler_options=quick_compilation())
        self._heading, self._middle = 0.0, np.zeros(dimension)
        self._near: np.ndarray = np.zeros((0, dimension))
        self._command(np.zeros(dimension), np.zeros(dimension), 0.0)  # compiles now

    def measure(self, new: Measurement) -> str | None:
        model = self._drive.model
        if isinstance(model, Unicycle) and new.heading is None:
            return "heading is missing: which way the robot looks, rad"
        others = new.neighbours
        if others is None:
            return "neighbours is missing: the positions of the robots near it, [] for nobody"
        heading, middle = new.heading or 0.0, new.position
        if isinstance(model, Unicycle):  # constraints apply to the steered point
            ahead = float(np.max(model.offset)) * np.array([np.cos(heading), np.sin(heading)])
            new = new._replace(position=new.position + ahead)
        if (why := super().measure(new)) is None:
            self._heading, self._near, self._middle = heading, others, middle
        return why

    def command(self, target: np.ndarray, now: float) -> np.ndarray:
        if self._good is None or not self.sensed(now):
            return np.zeros_like(target)
        elapsed, self._last = min(max(now - self._last, 0.0), HELD), now
        place = self._good.position
        return self._command(self._middle, self._ahead(place, target), elapsed)

    def named(self, command: np.ndarray) -> dict[str, Any]:
        if isinstance(self._drive.model, Unicycle):
            return {"v": float(command[0]), "omega": float(command[1])}
        return super().named(command)

    def _ahead(self, place: np.ndarray, target: np.ndarray) -> np.ndarray:
        """(d,) next point of the path from `place` to `target`."""
        if self._planner is None:
            return target
        size = float(self._drive.size[0])
        moved = len(self._path) == 0 or np.linalg.norm(self._path[-1] - target) > 0.5 * size
        if moved or not self._planner.seen(place[None], self._path[:1])[0]:
            self._path = self._planner.path(place, target)
        while len(self._path) > 1 and np.linalg.norm(self._path[0] - place) < 0.5 * size:
            self._path = self._path[1:]
        return target if len(self._path) == 1 else self._path[0]

    def _command(self, middle: np.ndarray, ahead: np.ndarray, elapsed: float) -> np.ndarray:
        others = self._near[np.argsort(np.linalg.norm(self._near - middle, axis=1))[: SEEN + 1]]
        missing = SEEN + 1 - len(others)
        everybody = np.concatenate([middle[None], others, np.full((missing, len(middle)), LARGEST)])
        command, blocked = self._steer(everybody, ahead, *(on_device(value) for value in (self._heading, self._blocked, elapsed)))
        self._blocked = float(blocked)
        return np.array(command)

    def _steered(self, everybody: Array, ahead: Array, heading: Array, blocked: Array, elapsed: Array) -> tuple[Array, Array]:
        """The command of the robot, and its state of deadlock resolution: the number of right angles by which its desired motion turns.

        Args:
            everybody: (k, d) centres of the bodies, this robot first.
            ahead: (d,) next point of the path.
            heading: () heading, rad.
            blocked: () state of deadlock resolution.
            elapsed: () time since the last command, s.
        """
        drive, count = self._drive, len(everybody)
        model, size = drive.model, jnp.full(count, self._kept)
        middle = everybody[:1]
        state = UnicycleState(middle, heading[None]) if isinstance(model, Unicycle) else model.start(middle)
        own, one = model.place(state), jnp.full(1, float(drive.size[0]))
        _, around = near(candidates(everybody), everybody, SEEN, drive.range)
        planes = safety.neighbour_planes(everybody, None, size, around, SHARE, explained=drive.explained)
        first, mine = (jax.tree.map(lambda leaf: leaf[:1], each) for each in (planes, around))
        first = first._replace(least=first.least + along(first.normals, own - middle))
        allowed = first
        if drive.map.count:
            allowed = safety.joined(
                first, safety.obstacle_planes(own, None, one, drive.map, drive.parts, share=SHARE, explained=drive.explained)
            )
        way = ahead[None] - own
        left = jnp.linalg.norm(way, axis=1)
        way, underway = way / jnp.maximum(left, 1e-9)[:, None], left >= drive.arrives
        pace = model.approach(left, HELD)
        gap = jnp.sqrt(jnp.sum((middle[:, None] - everybody[mine.who % count]) ** 2, axis=2)) - 2.0 * self._kept
        there = mine.who < count
        seen = deadlock.Sight(first.normals, jnp.where(there, gap, jnp.inf), jnp.zeros_like(first.normals), there)
        wish = deadlock.bent(drive.rules, way, pace, model.pace(1), underway=underway, blocked=blocked[None], seen=seen)
        command, _, straight = safety.steered(model, state, wish, way * pace[:, None], allowed, HELD)
        turned = deadlock.refused(drive.rules, blocked[None], way, pace, straight, underway=underway, dt=elapsed)
        return self._within(state, command, first, along(first.normals, own) - first.least)[0], turned[0]

    def _within(self, state: Any, command: Array, planes: safety.Planes, room: Array) -> Array:
        """The command, (1, m), scaled down until the centre of the body moves towards each neighbour by at most `room`, (1, k), and in
        total by at most the slack of the planes. If scaling is not sufficient, the command to stop."""
        model = self._drive.model

        def moved(command: Array) -> tuple[Array, Array]:
            way = model.body(model.step(state, command, HELD)) - model.body(state)
            return -along(planes.normals, way), jnp.linalg.norm(way, axis=1)

        towards, far = moved(command)
        part = jnp.min(jnp.where(towards > 0.0, room / jnp.where(towards > 0.0, towards, 1.0), 1.0), axis=1, initial=1.0)
        part = jnp.clip(jnp.minimum(part, planes.slack / jnp.maximum(far, 1e-12)), 0.0, 1.0)
        command = command * part[:, None]
        towards, far = moved(command)
        fine = jnp.all(towards <= room + safety.ROUNDING, axis=1) & (far <= planes.slack + safety.ROUNDING)
        return jnp.where(fine[:, None], command, model.halt(state, HELD))
