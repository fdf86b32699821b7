"""Bodies in MuJoCo: quadrotors and differential drives of primitive shapes, written as MJCF, among the obstacles of the map.

A quadrotor has four rotors with limited thrust, under the geometric controller of `consat.robots.quadrotor`. A differential drive has two
driven wheels and a caster on a floor with friction; its steered point follows that of its reference. All have the same drag in the air.
MuJoCo detects contacts between the bodies of the models: the ball of a quadrotor, the disc of a drive.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np
from scipy.spatial.transform import Rotation

from consat.errors import InvalidSettings
from consat.robots.double import DoubleState
from consat.robots.model import Model
from consat.robots.obstacles import Box, Disc, Polygon
from consat.robots.quadrotor import DRAG, GRAVITY, Quadrotor
from consat.robots.simulated import Bodies, kinds_of
from consat.robots.unicycle import Unicycle, UnicycleState

SOLID = {"contype": 1, "conaffinity": 1}
"""Attributes of bodies and obstacles, which collide with each other."""
ROLLING = {"contype": 2, "conaffinity": 2}
"""Attributes of wheels, casters and the floor, which collide with each other."""
SHOWN = {"contype": 0, "conaffinity": 0, "mass": 0}
"""Attributes of shapes that are only drawn."""
TALL = 10.0
"""Half the height of obstacles of the plane, m."""

LIFT, INERTIA = 2.0, (0.15, 0.15, 0.27)
"""Quadrotor: largest thrust, relative to the weight; moments of inertia, in mass·radius²."""
ARM, YAW = 0.6, 0.1
"""Quadrotor, in radii: length of the arms; ratio of a rotor's drag moment to its thrust."""
MIXER = np.array([[1, 1, 1, 1], [1, 1, -1, -1], [-1, 1, 1, -1], [1, -1, 1, -1]])
"""Signs of thrust and of the moments about three axes, for rotors at (+, +), (−, +), (−, −) and (+, −). Neighbours counter-rotate."""
RATES = 60.0
"""Gain of the turn-rate loop, 1/s."""
LEARNING, LEARNT = 15.0, 3.0
"""Integral action against a steady wind: gain, 1/s³, and limit, m/s²."""

WHEEL, TRACK, CASTER = 0.35, 0.85, 0.75
"""Drive, in radii: radius of the wheels, half the distance between them, distance of the caster behind the axle."""
HIGH, BEHIND = 0.3, 0.2
"""Drive, in radii: height of the centre of mass above the floor, and its distance behind the axle."""
SPIN = 0.4
"""Drive: moment of inertia about the vertical axis, in mass·radius²."""
SERVO, GRIP = 0.01, 6.0
"""Drive: time constant of the wheels' speed loop, s; largest acceleration by the motors, m/s²."""
FOLLOWING = 8.0
"""Drive: gain of the loop that follows the reference, 1/s."""
MORE = 1.25
"""Drive: largest speed of that loop, relative to the limits of the reference."""
REST, LAG = 0.01, 0.025
"""Drive: constant part of the tube, m, and time that multiplies the speed, s."""


COLUMNS = {"place": 9, "speed": 8, "warm": 8, "push": 3}
"""Columns of `Bodies.inner`, padded with 0. Place: position, unit quaternion, angles of two wheels. Speed: velocity in the world frame,
turn rate in the body frame, turn rates of two wheels. Warm: last accelerations, the initial guess of the contact solver. Push: acceleration
of quadrotors against the wind, m/s²."""


class _Now(NamedTuple):
    """Measurements of n robots of a kind: as in `COLUMNS`, and attitude, (n, 3, 3); mass, (n,), kg; inertia, (n, 3), kg m²."""

    place: np.ndarray
    speed: np.ndarray
    attitude: np.ndarray
    push: np.ndarray
    mass: np.ndarray
    inertia: np.ndarray


_Control = Callable[[_Now, float, float], tuple[np.ndarray, np.ndarray]]
"""Controller: from measurements, time since the step began, s, and hold time, s, to motor inputs, (n, motors), and the new push."""


class _Design(NamedTuple):
    """Construction and control of the robots of a kind.

    Attributes:
        step: largest time step of physics and controller, s.
        motors: number of motors of each robot.
        joints: number of joints besides the six degrees of freedom of the body.
        height: height of the body's frame above the floor, in radii; 0 for flying robots.
        tube: largest allowed distance of a body from its reference, m, from the model.
        body: writes a body of a name and radius to the world and the actuators.
        control: makes the controller for two states of the references, dt apart.
    """

    step: float
    motors: int
    joints: int
    height: float
    tube: Callable[[Any], Any]
    body: Callable[[ElementTree.Element, ElementTree.Element, str, float], None]
    control: Callable[[Any, Any, Any, float], _Control]


class _Group(NamedTuple):
    """Robots of one kind: model, indices, (n,), radii, (n,), design, and indices of the actuators, (n, motors)."""

    kind: Any
    rows: np.ndarray
    radius: np.ndarray
    design: _Design
    motors: np.ndarray


class Simulator:
    """See `consat.robots.simulated.Simulator`.

    Args:
        model: model of the robots: `Quadrotor`, `Unicycle` or a `Fleet` of both.
        count: number of robots, N.
        dimension: dimension of space, d.
        obstacles: public map.

    Attributes:
        mjcf: MJCF of the scene.

    Raises:
        InvalidSettings: MuJoCo is not installed, or a kind of robot has no body here.
    """

    width = sum(COLUMNS.values())

    def __init__(self, model: Model[Any], count: int, dimension: int, obstacles: Sequence[Any]) -> None:
        try:
            import mujoco
        except ImportError:
            raise InvalidSettings("simulator mujoco needs the library mujoco-core; install it with: pip install 'consat[mujoco]'") from None
        kinds = kinds_of(model, count)
        if other := [type(kind).__name__.lower() for kind, _ in kinds if type(kind) not in DESIGNS]:
            raise InvalidSettings(f"simulator mujoco has no body for {other[0]} robots; use unicycle or quadrotor robots")
        self._mujoco, self._dimension = mujoco, dimension
        self._groups = [_group(kind, rows) for kind, rows in kinds]
        self.tube = self._each(lambda group: group.design.tube(group.kind))
        self.acceleration = self._each(lambda group: GRIP if group.design.joints else np.inf)
        self._height = self._each(lambda group: group.design.height * group.radius)
        self.mjcf = _scene(self._groups, dimension, obstacles)
        self._model = compiled = mujoco.MjModel.from_xml_string(self.mjcf)
        self._data = mujoco.MjData(compiled)
        self._bodies = np.array([compiled.body(_name(i)).id for i in range(count)])
        self._mass, self._inertia = compiled.body_subtreemass[self._bodies], compiled.body_inertia[self._bodies]
        joints = compiled.body_jntadr[self._bodies]
        own = self._each(lambda group: group.design.joints).astype(int)
        self._place = _Slots.of(compiled.jnt_qposadr[joints], 7 + own, 9)
        self._speed = _Slots.of(compiled.jnt_dofadr[joints], 6 + own, 8)
        numbers = np.full(compiled.nbody, count)
        numbers[self._bodies] = np.arange(count)
        solid = compiled.geom_contype == SOLID["contype"]
        self._owner = np.where(solid, numbers[compiled.geom_bodyid], -1)  # N: obstacle; −1: not solid

    def start(self, place: np.ndarray) -> Bodies:
        count = len(place)
        inner, apart = np.zeros((count, self.width)), np.zeros((count, count), dtype=bool)
        inner[:, : self._dimension] = place
        inner[:, 0] -= self._each(lambda group: group.kind.offset if isinstance(group.kind, Unicycle) else 0.0)
        inner[:, 3] = 1.0
        return Bodies(inner[:, :3], np.zeros((count, 3)), np.zeros(count), inner, apart, apart.any(axis=1))

    def step(self, bodies: Bodies, before: Any, after: Any, wind: np.ndarray, *, dt: float) -> Bodies:
        model, data, groups, count = self._model, self._data, self._groups, len(bodies.heading)
        steps = max(math.ceil(dt / group.design.step - 1e-9) for group in groups)
        model.opt.timestep = hold = dt / steps
        place, speed, warm, push = (part.copy() for part in np.split(bodies.inner, np.cumsum(list(COLUMNS.values()))[:-1], axis=1))
        place[:, 2] += self._height
        self._place.write(data.qpos, place)
        self._speed.write(data.qvel, speed)
        self._speed.write(data.qacc_warmstart, warm)
        ends = [(before, after)] if len(groups) == 1 else zip(before, after, strict=True)
        controls = [group.design.control(group.kind, *each, dt) for group, each in zip(groups, ends, strict=True)]
        air, attitude = _in_space(wind), _matrices(place[:, 3:7])
        touching, struck = np.zeros((count, count), dtype=bool), np.zeros(count, dtype=bool)
        for index in range(steps):
            for group, control in zip(groups, controls, strict=True):
                now = _Now(*(part[group.rows] for part in (place, speed, attitude, push, self._mass, self._inertia)))
                data.ctrl[group.motors], push[group.rows] = control(now, hold * index, hold)
            data.xfrc_applied[self._bodies, :3] = -DRAG * self._mass[:, None] * (speed[:, :3] - air)
            self._mujoco.mj_step(model, data)
            place, speed = self._place.read(data.qpos), self._speed.read(data.qvel)
            attitude = _matrices(place[:, 3:7])
            if data.ncon:
                self._look(touching, struck)
        place[:, 2] -= self._height
        heading = np.arctan2(attitude[:, 1, 0], attitude[:, 0, 0])
        inner = np.concatenate([place, speed, self._speed.read(data.qacc_warmstart), push], axis=1)
        return Bodies(place[:, :3], speed[:, :3], heading, inner, touching, struck)

    def _look(self, touching: np.ndarray, struck: np.ndarray) -> None:
        """Record contacts between two robots, and between a robot and an obstacle."""
        contact = self._data.contact
        pairs = np.sort(self._owner[contact.geom], axis=1)[contact.dist < 0.0]
        first, second = pairs[pairs[:, 0] >= 0].T
        robots = second < len(struck)
        touching[first[robots], second[robots]] = True
        struck[first[~robots]] = True

    def _each(self, value: Callable[[_Group], Any]) -> np.ndarray:
        """(N,) values, from one value, or one for each robot, of each kind."""
        values = np.zeros(sum(len(group.rows) for group in self._groups))
        for group in self._groups:
            values[group.rows] = value(group)
        return values


class _Slots(NamedTuple):
    """Places of each robot's entries in a vector of MuJoCo, and in an array of N rows that is padded with 0."""

    row: np.ndarray
    column: np.ndarray
    place: np.ndarray
    shape: tuple[int, int]

    @classmethod
    def of(cls, first: np.ndarray, own: np.ndarray, width: int) -> _Slots:
        """Args: first: (N,) index of each robot's first entry; own: (N,) number of its entries; width: length of the rows."""
        row, column = np.nonzero(np.arange(width)[None] < own[:, None])
        return cls(row, column, first[row] + column, (len(first), width))

    def write(self, vector: np.ndarray, rows: np.ndarray) -> None:
        vector[self.place] = rows[self.row, self.column]

    def read(self, vector: np.ndarray) -> np.ndarray:
        rows = np.zeros(self.shape)
        rows[self.row, self.column] = vector[self.place]
        return rows


# ---- quadrotors -------------------------------------------------------------------------------------------------------------------------


def _flown(kind: Quadrotor, before: DoubleState, after: DoubleState, dt: float) -> _Control:
    """Controller of quadrotors: thrust of four rotors, N, from thrust and moments as in Lee, Leok, McClamroch, CDC 2010."""
    begin, old, new = map(_in_space, (before.position, before.velocity, after.velocity))
    pull = (new - old) / dt
    levers = np.broadcast_to(kind.radius, len(begin))[:, None] * np.array([ARM, ARM, math.sqrt(2.0) * YAW]) / math.sqrt(2.0)

    def control(now: _Now, time: float, hold: float) -> tuple[np.ndarray, np.ndarray]:
        target, pace = begin + time * old + 0.5 * time**2 * pull, old + time * pull
        position, velocity, turning = now.place[:, :3], now.speed[:, :3], now.speed[:, 3:6]
        push = np.clip(now.push + hold * LEARNING * (target - position), -LEARNT, LEARNT)
        thrust, rates = kind.control(position, velocity, now.attitude, target, pace, pull + push)
        moments = now.inertia * RATES * (rates - turning) + np.cross(turning, now.inertia * turning)
        wanted = np.concatenate([(now.mass * thrust)[:, None], moments / levers], axis=1)
        return np.clip(0.25 * wanted @ MIXER, 0.0, 0.25 * LIFT * GRAVITY * now.mass[:, None]), push

    return control


def _quadrotor(world: ElementTree.Element, actuators: ElementTree.Element, name: str, radius: float) -> None:
    """A ball. The hull, four arms and the rotors inside are only drawn."""
    dark, grey, red = "0.2 0.2 0.25 1", "0.5 0.5 0.55 0.8", "0.8 0.3 0.2 0.8"
    body = _add(world, "body", name=name)
    _add(body, "freejoint")
    _add(body, "inertial", pos=(0, 0, 0), mass=1, diaginertia=radius**2 * np.array(INERTIA))
    _add(body, "geom", type="sphere", size=radius, rgba="0.3 0.5 0.8 0.15", **SOLID)
    _add(body, "geom", type="box", size=radius * np.array([0.25, 0.15, 0.1]), rgba=dark, **SHOWN)
    for motor, (x, y) in enumerate(((1, 1), (-1, 1), (-1, -1), (1, -1))):
        end = ARM * radius / math.sqrt(2.0) * np.array([x, y, 0])
        _add(body, "geom", type="capsule", fromto=(0, 0, 0, *end), size=0.05 * radius, rgba=dark, **SHOWN)
        above, shape = end + np.array([0, 0, 0.08 * radius]), radius * np.array([0.35, 0.02])
        _add(body, "geom", type="cylinder", pos=above, size=shape, rgba=red if x > 0 else grey, **SHOWN)
        _add(body, "site", name=f"{name} {motor}", pos=end)
        gear, limits = (0, 0, 1, 0, 0, MIXER[3, motor] * YAW * radius), (0, 0.25 * LIFT * GRAVITY)
        _add(actuators, "motor", name=f"{name} {motor}", site=f"{name} {motor}", gear=gear, ctrlrange=limits)


# ---- differential drives ----------------------------------------------------------------------------------------------------------------


def _rolled(kind: Unicycle, before: UnicycleState, after: UnicycleState, dt: float) -> _Control:
    """Controller of drives: speeds of two wheels, rad/s. The steered point ahead of the axle follows that of the reference."""
    axle, angle, half = np.asarray(before.axle), np.asarray(before.angle), 0.5 * np.asarray(after.angle - before.angle)
    chord = np.sum((after.axle - axle) * _ahead(angle + half), axis=1)
    pace, rate = chord / (dt * np.sinc(half / np.pi)), 2.0 * half / dt
    top, most, radius, offset = (np.broadcast_to(value, len(angle)) for value in (kind.speed, kind.turn_rate, kind.radius, kind.offset))

    def control(now: _Now, time: float, hold: float) -> tuple[np.ndarray, np.ndarray]:
        turned = rate * time
        there, ahead = _ahead(angle + turned), now.attitude[:, :2, 0]
        middle = axle + (pace * time * np.sinc(0.5 * turned / np.pi))[:, None] * _ahead(angle + 0.5 * turned)
        error = middle + offset[:, None] * there - now.place[:, :2] - offset[:, None] * ahead
        wish = pace[:, None] * there + (offset * rate)[:, None] * _across(there) + FOLLOWING * error
        v, w = np.sum(wish * ahead, axis=1), np.sum(wish * _across(ahead), axis=1) / offset
        part = np.minimum(1.0, MORE / np.maximum(np.abs(v) / top, np.maximum(np.abs(w) / most, 1e-9)))
        wheels = (part / (WHEEL * radius))[:, None] * np.stack([v - w * TRACK * radius, v + w * TRACK * radius], axis=1)
        return wheels, now.push

    return control


def _late(kind: Unicycle) -> Any:
    """Largest distance of a drive behind its reference, m, measured with random commands.

    If the reference halts at once, the body stops at its steered point, which is kept free anyway.
    """
    return REST + kind.speed * (LAG + kind.turn_rate * kind.radius * LAG)


def _drive(world: ElementTree.Element, actuators: ElementTree.Element, name: str, radius: float) -> None:
    """A disc with a wheel on each side and a caster behind. Its frame is at the middle of the axle."""
    wheel, ball = WHEEL * radius, 0.15 * radius
    body = _add(world, "body", name=name)
    _add(body, "freejoint")
    middle = (-BEHIND * radius, 0, HIGH * radius - wheel)
    _add(body, "inertial", pos=middle, mass=1, diaginertia=radius**2 * np.array([0.5, 0.5, 1.0]) * SPIN)
    _add(body, "geom", type="cylinder", pos=(0, 0, 0.15 * radius), size=(radius, 0.4 * radius), rgba="0.3 0.5 0.8 1", **SOLID)
    nose, bar = radius * np.array([0.6, 0, 0.56]), radius * np.array([0.25, 0.06, 0.02])
    _add(body, "geom", type="box", pos=nose, size=bar, rgba="1 1 1 1", **SHOWN)
    caster = (-CASTER * radius, 0, ball - wheel)
    _add(body, "geom", type="sphere", pos=caster, size=ball, condim=1, priority=1, mass=0, rgba="0.5 0.5 0.55 1", **ROLLING)
    for motor, side in enumerate((1, -1)):
        part = _add(body, "body", pos=(0, side * TRACK * radius, 0))
        _add(part, "joint", name=f"{name} {motor}", type="hinge", axis=(0, 1, 0), armature=1e-5)
        shape = {"type": "cylinder", "size": (wheel, 0.08 * radius), "euler": (math.pi / 2, 0, 0)}
        _add(part, "geom", mass=0.05, friction=(1, 1e-3, 1e-4), rgba="0.15 0.15 0.15 1", **shape, **ROLLING)
        force, gain = 0.5 * GRIP * wheel, 0.5 * wheel**2 / SERVO
        _add(actuators, "velocity", name=f"{name} {motor}", joint=f"{name} {motor}", kv=gain, forcerange=(-force, force))


DESIGNS: dict[type, _Design] = {
    Quadrotor: _Design(0.005, 4, 0, 0.0, lambda kind: kind.tube, _quadrotor, _flown),
    Unicycle: _Design(0.0025, 2, 2, WHEEL, _late, _drive, _rolled),
}
"""The design of each kind of robot that has a body in MuJoCo."""


# ---- the scene --------------------------------------------------------------------------------------------------------------------------


def _group(kind: Any, rows: np.ndarray) -> _Group:
    design = DESIGNS[type(kind)]
    motors = np.zeros((len(rows), design.motors), dtype=int)
    return _Group(kind, rows, np.broadcast_to(kind.radius, len(rows)), design, motors)


def _scene(groups: Sequence[_Group], dimension: int, obstacles: Sequence[Any]) -> str:
    """MJCF of a team among obstacles. Fills in `_Group.motors`."""
    root = ElementTree.Element("mujoco", model="consat")
    _add(root, "compiler", angle="radian", autolimits="true")
    option = _add(root, "option", gravity=(0, 0, -GRAVITY), integrator="implicitfast", cone="elliptic", impratio=10)
    _add(option, "flag", autoreset="disable")
    asset, world, actuators = _add(root, "asset"), _add(root, "worldbody"), _add(root, "actuator")
    _add(world, "light", pos=(0, 0, 20), dir=(0, 0, -1))
    if any(group.design.joints for group in groups):
        _add(world, "geom", type="plane", size=(0, 0, 1), rgba="0.9 0.9 0.88 1", **ROLLING)
    for number, obstacle in enumerate(obstacles):
        for shape in _shapes(obstacle, dimension, number, asset):
            _add(world, "geom", rgba="0.6 0.6 0.6 1", **shape, **SOLID)
    written = 0
    for group in groups:
        for k, row in enumerate(group.rows.tolist()):
            group.design.body(world, actuators, _name(row), float(group.radius[k]))
            group.motors[k] = written + np.arange(group.design.motors)
            written += group.design.motors
    return ElementTree.tostring(root, encoding="unicode")


def _shapes(obstacle: Any, dimension: int, number: int, asset: ElementTree.Element) -> Iterator[dict[str, Any]]:
    """Yield the geoms of an obstacle. Obstacles of the plane are extruded."""
    flat = dimension < 3
    if isinstance(obstacle, Disc):
        size = (obstacle.radius, TALL) if flat else obstacle.radius
        yield {"type": "cylinder" if flat else "sphere", "pos": _in_space(np.array([obstacle.center]))[0], "size": size}
    elif isinstance(obstacle, Box):
        low, high = (np.array([*side, end][:3]) for side, end in ((obstacle.low, -TALL), (obstacle.high, TALL)))
        yield {"type": "box", "pos": 0.5 * (low + high), "size": 0.5 * (high - low)}
    elif isinstance(obstacle, Polygon):
        import shapely

        for part, triangle in enumerate(shapely.constrained_delaunay_triangles(shapely.Polygon(obstacle.vertices)).geoms):
            name, corners = f"obstacle {number} {part}", triangle.exterior.coords[:3]
            _add(asset, "mesh", name=name, vertex=np.ravel([(x, y, z) for x, y in corners for z in (-TALL, TALL)]))
            yield {"type": "mesh", "mesh": name}


def _name(robot: int) -> str:
    return f"robot {robot}"


def _add(parent: ElementTree.Element, tag: str, /, **attributes: Any) -> ElementTree.Element:
    """Add an element. Attributes are text, numbers or vectors."""
    attributes = {
        key: value if isinstance(value, str) else " ".join(f"{float(each):.10g}" for each in np.atleast_1d(value))
        for key, value in attributes.items()
    }
    return ElementTree.SubElement(parent, tag, attributes)


def _in_space(vectors: Any) -> np.ndarray:
    """(N, d) → (N, 3), padded with 0."""
    return np.pad(vectors, ((0, 0), (0, 3 - vectors.shape[1])))


def _ahead(angle: np.ndarray) -> np.ndarray:
    return np.stack([np.cos(angle), np.sin(angle)], axis=1)


def _across(ahead: np.ndarray) -> np.ndarray:
    return np.stack([-ahead[:, 1], ahead[:, 0]], axis=1)


def _matrices(quaternions: np.ndarray) -> np.ndarray:
    """Rotation matrices, (N, 3, 3), of quaternions, (N, 4)."""
    return Rotation.from_quat(quaternions, scalar_first=True).as_matrix()
