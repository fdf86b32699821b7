"""Robots that swap places and cross random crowds: consat, ORCA (pyrvo), and one central QP for all as the Robotarium has it (piqp).

    python benchmarks/robots.py [--part swaps crowds obstacles steps oracle mujoco] [--scenes 100] [--most 1000] [--out docs/benchmarks]

Needs `pip install pyrvo piqp mujoco-core`. Writes ``robots.md``, ``robots.png`` and ``robots.json``, from which parts that are not asked
for are taken as last measured. A part that is cut short keeps what it has; run it again for all of it.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import platform
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import oracle
import piqp
import scipy.sparse as sp
from matplotlib.figure import Figure
from pyrvo import RVOSimulator
from scipy.spatial import cKDTree

import consat
from consat.engine.bodies import PATH, Driven
from consat.engine.ways import Ways
from consat.robots import Double, Drive, Point, Quadrotor, Unicycle, box, disc, simulated

RADIUS, SPEED, DT = 0.1, 0.5, 0.05
GAIN = 100.0
"""Of the Robotarium's barrier certificate, γ h³, its default."""
TOUCH = -1e-6
"""Robots touch where their gap is below that, m: pyrvo computes in float32."""


@dataclass
class Outcome:
    """Of one scene: time until all have arrived (None: never), over the straight-line time; smallest gap, m; pairs that touched, and times
    that an obstacle was; path over straight line; robots that have not arrived; ms a step; smallest distance to an obstacle, m."""

    time: float | None
    gap: float
    contacts: int
    path: float
    left: int
    step: float
    clearance: float | None = None


def circle(count: int, scale: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Everybody to the opposite side."""
    radius = scale * max(1.0, 0.384 * count / np.pi)
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False) + 0.01
    starts = radius * np.c_[np.cos(angle), np.sin(angle)]
    return starts, -starts


def scattered(count: int, seed: int, dimension: int = 2, scale: float = 1.0, apart: float = 0.3) -> tuple[np.ndarray, np.ndarray]:
    """Random starts and goals, as dense whatever their number."""
    rng, side = np.random.default_rng(seed), 0.55 * scale * count ** (1 / dimension)
    return apart_from(rng, count, side, dimension, apart * scale), apart_from(rng, count, side, dimension, apart * scale)


def apart_from(rng: np.random.Generator, count: int, side: float, dimension: int, apart: float) -> np.ndarray:
    """Random points within ±side, `apart` or more from each other."""
    points = np.zeros((0, dimension))
    while len(points) < count:
        points = np.concatenate([points, rng.uniform(-side, side, (count, dimension))])
        drop = {second for _, second in sorted(cKDTree(points).query_pairs(apart))}
        points = np.delete(points, sorted(drop), axis=0)
    return points[:count]


def limit_of(starts: np.ndarray, goals: np.ndarray) -> float:
    return 5.0 * np.linalg.norm(starts - goals, axis=1).max() / SPEED + 20.0


CHUNK = 20
"""Steps at a time; after each the robots look whether they need another way, as in `consat run`."""


class Consat:
    """Steps of a `Drive`, compiled once for each number of robots."""

    def __init__(self, model, obstacles=()):
        self.model, self.obstacles, self.programs = model, obstacles, {}

    def _compiled(self, count, dimension, planned):
        if (count, dimension) not in self.programs:
            self.programs[count, dimension] = self._compile(count, dimension, planned)
        return self.programs[count, dimension]

    def _compile(self, count, dimension, planned):
        drive = Drive(self.model, count, dimension, DT, self.obstacles)
        ways = Ways(drive, CHUNK) if planned else None

        @jax.jit
        def chunk(state, memory, goals, paths, path):
            def body(carry, _):
                state, memory, path, at, steps = carry
                done = jnp.all(drive.arrived(state, goals))
                place = drive.model.place(state)
                new, after, _ = drive.step(state, memory, goals, paths=paths)
                path = path + jnp.where(done, 0.0, jnp.linalg.norm(drive.model.place(new) - place, axis=1))
                kept = jax.tree.map(lambda a, b: jnp.where(done, b, a), (new, after), (state, memory))
                return (*kept, path, at, steps + jnp.where(done, 0, 1)), None

            start = (state, memory, path, jnp.asarray(0), jnp.asarray(0))
            (state, memory, path, _, steps), _ = jax.lax.scan(body, start, length=CHUNK)
            return state, memory, path, steps

        return drive, ways, chunk

    def __call__(self, starts, goals, record=None):
        drive, ways, chunk = self._compiled(*starts.shape, bool(self.obstacles))
        state = drive.model.start(jnp.asarray(starts))
        memory, target, path = drive.start(state), jnp.asarray(goals), jnp.zeros(len(starts))
        steps, spent, limit = 0, [], limit_of(starts, goals)
        paths = None
        while steps * DT < limit:
            if ways is not None:
                paths = jnp.repeat(jnp.asarray(starts)[:, None], PATH, axis=1) if paths is None else paths
                planned = ways.planned(Driven(state, memory, paths), np.asarray(drive.model.place(state)), goals)
                memory, paths = planned.memory, planned.paths
            if steps == 0:
                warm = chunk(state, memory, target, paths, path)  # compiles
                jax.block_until_ready(chunk(*warm[:2], target, paths, warm[2]))  # and once more, for what has no weak types
            begin = time.perf_counter()
            state, memory, path, taken = jax.block_until_ready(chunk(state, memory, target, paths, path))
            spent.append((time.perf_counter() - begin) / CHUNK)
            steps += int(taken)
            if record is not None:
                record.append(np.asarray(drive.model.place(state)))
            if int(taken) < CHUNK:
                break
        memory = drive.observed(state, memory)
        report = memory.report
        arrived = np.asarray(drive.arrived(state, target))
        straight = np.linalg.norm(starts - goals, axis=1)
        return Outcome(
            steps * DT * SPEED / straight.max() if arrived.all() else None,
            float(report.smallest_distance),
            int(report.contacts) + int(report.collisions),
            float(np.mean(np.asarray(path) / straight)),
            int((~arrived).sum()),
            1e3 * float(np.median(spent)),
            float(report.clearance) if self.obstacles else None,
        )


def loop(starts, goals, move) -> Outcome:
    """`move(positions, wishes)` → positions after a step and the seconds that it took."""
    place, steps, gap, spent, path = starts.copy(), 0, np.inf, 0.0, np.zeros(len(starts))
    touched: set[tuple[int, int]] = set()
    straight = np.linalg.norm(starts - goals, axis=1)
    while steps * DT < limit_of(starts, goals):
        way = goals - place
        wish = way * np.minimum(SPEED / np.maximum(np.linalg.norm(way, axis=1), 1e-9), 1 / DT)[:, None]
        after, seconds = move(place, wish)
        path, place, spent, steps = path + np.linalg.norm(after - place, axis=1), after, spent + seconds, steps + 1
        tree = cKDTree(place)
        gap = min(gap, tree.query(place, 2)[0][:, 1].min() - 2 * RADIUS)
        touched |= tree.query_pairs(2 * RADIUS + TOUCH)
        if (np.linalg.norm(place - goals, axis=1) < RADIUS).all():
            return Outcome(steps * DT * SPEED / straight.max(), gap, len(touched), float(np.mean(path / straight)), 0, 1e3 * spent / steps)
    left = int((np.linalg.norm(place - goals, axis=1) >= RADIUS).sum())
    return Outcome(None, gap, len(touched), float(np.mean(path / straight)), left, 1e3 * spent / steps)


def orca(starts, goals):
    """pyrvo's own recommendation against symmetry: a little noise on the wish."""
    simulator, rng = RVOSimulator(), np.random.default_rng(0)
    simulator.set_time_step(DT)
    simulator.set_agent_defaults(2.0, 10, 2.0, 2.0, RADIUS, SPEED)
    for place in starts:
        simulator.add_agent(tuple(map(float, place)))

    def move(place, wish):
        for index, each in enumerate(wish + 1e-3 * rng.normal(size=wish.shape)):
            simulator.set_agent_pref_velocity(index, tuple(map(float, each)))
        begin = time.perf_counter()
        simulator.do_step()
        seconds = time.perf_counter() - begin
        found = (simulator.get_agent_position(index) for index in range(len(place)))
        return np.array([[each.x, each.y] for each in found]), seconds

    return loop(starts, goals, move)


def central(starts, goals):
    """One QP over all pairs, as `create_single_integrator_barrier_certificate` of the Robotarium: 2 e·(u_i − u_j) ≥ −γ h³, h = ‖e‖² − (2r)²,
    solved to 1e-2; nobody moves when it fails."""
    count = len(starts)
    first, second = np.triu_indices(count, 1)
    rows = np.arange(len(first))
    solver = piqp.SparseSolver()
    solver.settings.eps_abs = solver.settings.eps_rel = 1e-2
    weight = sp.eye(2 * count, format="csc")

    def move(place, wish):
        begin = time.perf_counter()
        apart = place[first] - place[second]
        level = -0.5 * GAIN * ((apart**2).sum(axis=1) - (2 * RADIUS) ** 2) ** 3
        index = np.concatenate([2 * first, 2 * first + 1, 2 * second, 2 * second + 1])
        values = np.concatenate([apart[:, 0], apart[:, 1], -apart[:, 0], -apart[:, 1]])
        matrix = sp.csc_matrix((values, (np.tile(rows, 4), index)), shape=(len(rows), 2 * count))
        solver.setup(weight, -wish.ravel(), None, None, matrix, level, np.full(len(rows), 1e30))
        done = solver.solve() == piqp.PIQP_SOLVED
        velocity = solver.result.x.reshape(-1, 2) if done else np.zeros_like(place)
        speed = np.linalg.norm(velocity, axis=1)
        velocity = velocity * np.minimum(1.0, SPEED / np.maximum(speed, 1e-9))[:, None]
        return place + DT * velocity, time.perf_counter() - begin

    return loop(starts, goals, move)


def swaps(asked: argparse.Namespace) -> Iterator[dict[str, Any]]:
    for count in [count for count in (8, 20, 50, 100, 200, 500, 1000) if count <= asked.most]:
        ways = {"consat, points": Consat(Point(RADIUS, SPEED)), "ORCA": orca}
        if count <= CENTRAL:
            ways["one QP for all"] = central
        for name, way in ways.items():
            yield {"scene": f"circle of {count}", "method": name, **asdict(way(*circle(count)))}
        wide = Consat(Unicycle(RADIUS, SPEED))(*circle(count, 1.6))
        yield {"scene": f"circle of {count}, 1.6 times as wide", "method": "consat, unicycles", **asdict(wide)}


CENTRAL = 50
"""One QP for all has a row for each pair: up to so many robots."""


def swaps_told(rows: list[dict[str, Any]]) -> Iterator[str]:
    yield "| scene | method | time over straight-line time | contacts | smallest gap, mm | path | ms a step |"
    yield "|---|---|--:|--:|--:|--:|--:|"
    for row in rows:
        when = "never" if row["time"] is None else f"{row['time']:.2f}"
        left = f" ({row['left']} left)" if row["left"] else ""
        yield (
            f"| {row['scene']} | {row['method']} | {when}{left} | {row['contacts']} | {1e3 * row['gap']:+.3f} | {row['path']:.2f} | {row['step']:.2f} |"
        )
    yield ""
    yield from beside([row for row in rows if row["method"] == "consat, points"], [row for row in rows if row["method"] == "ORCA"])


def beside(ours: list[dict[str, Any]], theirs: list[dict[str, Any]]) -> Iterator[str]:
    both = [(a["time"], b["time"]) for a, b in zip(ours, theirs, strict=False) if a["time"] and b["time"]]
    ratio = np.array([a / b for a, b in both]) if both else np.zeros(0)
    times = f"mean {ratio.mean():.3f}, median {np.median(ratio):.3f}, worst {ratio.max():.2f}" if both else "none"
    yield (
        f"consat's time over ORCA's, on the {len(both)} of {len(ours)} scenes where both arrive: {times}; over 1.2 on {int((ratio > 1.2).sum())}. "
        f"consat arrives on {sum(row['time'] is not None for row in ours)}, ORCA on {sum(row['time'] is not None for row in theirs)}; "
        f"contacts: {sum(row['contacts'] for row in ours)} and {sum(row['contacts'] for row in theirs)}."
    )


CROWDS = (10, 20, 35, 50, 70)


def crowds(asked: argparse.Namespace) -> Iterator[dict[str, Any]]:
    drive = Consat(Point(RADIUS, SPEED))
    for count in CROWDS:
        for seed in range(asked.scenes // len(CROWDS)):
            scene = scattered(count, seed)
            for method, way in {"consat, points": drive, "ORCA": orca}.items():
                yield {"robots": count, "seed": seed, "method": method, **asdict(way(*scene))}


def crowds_told(rows: list[dict[str, Any]]) -> Iterator[str]:
    yield "| method | scenes | all arrived | contacts | smallest gap, mm | time: mean | 95 % | worst | path |"
    yield "|---|--:|--:|--:|--:|--:|--:|--:|--:|"
    ways = {name: [row for row in rows if row["method"] == name] for name in ("consat, points", "ORCA")}
    for name, own in ways.items():
        times = np.array([np.inf if row["time"] is None else row["time"] for row in own])
        yield (
            f"| {name} | {len(own)} | {np.isfinite(times).sum()} | {sum(row['contacts'] for row in own)} | "
            f"{1e3 * min(row['gap'] for row in own):+.3f} | {times[np.isfinite(times)].mean():.3f} | "
            f"{np.quantile(times, 0.95, method='lower'):.2f} | {times.max():.2f} | {np.mean([row['path'] for row in own]):.3f} |"
        )
    yield ""
    yield from beside(*ways.values())


def shelves() -> list:
    """Shelves with a pillar between them."""
    boxes = [box([x, y], [x + 0.6, y + 2.0]) for x in (-4.5, -1.5, 1.5, 4.5) for y in (-4.0, 1.0)]
    return [*boxes, disc([0.3, 0.0], 0.5), disc([-3.0, -0.6], 0.4)]


AMONG = 30


def obstacles(asked: argparse.Namespace) -> Iterator[dict[str, Any]]:
    for name, model in {"points": Point(RADIUS, SPEED), "unicycles": Unicycle(RADIUS, SPEED)}.items():
        drive = Consat(model, shelves())
        clear = drive._compiled(AMONG, 2, True)[0].map
        for seed in range(max(2, asked.scenes // 10)):
            rng, places = np.random.default_rng(seed), []
            for _ in range(2):
                points = apart_from(rng, 4 * AMONG, 6.5, 2, 0.5)
                free = np.asarray(clear.signed_distance(jnp.asarray(points))) > 0.3
                places.append(points[free][:AMONG])
            ways = [places[0]]
            outcome = asdict(drive(*places, record=ways))
            yield {"robots": f"{AMONG} {name}", **outcome, "ways": np.round(ways, 3).tolist() if seed == 0 else None}


def obstacles_told(rows: list[dict[str, Any]]) -> Iterator[str]:
    yield "| robots | scenes | all arrived | contacts, with robots or obstacles | smallest gap, mm | clearance, mm | time: mean | worst | ms a step |"
    yield "|---|--:|--:|--:|--:|--:|--:|--:|--:|"
    for name in dict.fromkeys(row["robots"] for row in rows):
        own = [row for row in rows if row["robots"] == name]
        times = [row["time"] for row in own if row["time"] is not None]
        yield (
            f"| {name} | {len(own)} | {len(times)} | {sum(row['contacts'] for row in own)} | {1e3 * min(row['gap'] for row in own):+.3f} | "
            f"{1e3 * min(row['clearance'] for row in own):+.3f} | {np.mean(times):.2f} | {max(times):.2f} | {np.median([row['step'] for row in own]):.2f} |"
        )


def steps(asked: argparse.Namespace) -> Iterator[dict[str, Any]]:
    plane = {
        "points": (Point(RADIUS, SPEED), 1.0),
        "unicycles": (Unicycle(RADIUS, SPEED), 1.8),
        "double integrators": (Double(RADIUS, SPEED), 1.8),
        "quadrotors, at one height": (Quadrotor(RADIUS, SPEED), 1.8),
    }
    scenes = [(count, 2, name, *how) for count in (100, 1000) for name, how in plane.items() if count <= asked.most]
    for count, dimension, name, model, scale in [*scenes, (100, 3, "points in space", Point(RADIUS, SPEED), 1.0)]:
        starts, goals = scattered(count, 0, dimension, scale)
        drive, _, chunk = Consat(model)._compiled(count, dimension, False)
        state = drive.model.start(jnp.asarray(starts))
        carry, spent = (state, drive.start(state)), []
        for _ in range(12):
            begin = time.perf_counter()
            carry = jax.block_until_ready(chunk(*carry, jnp.asarray(goals), None, jnp.zeros(count)))[:2]
            spent.append(1e3 * (time.perf_counter() - begin) / CHUNK)
        warm = spent[2:]  # the first two compile
        yield {
            "robots": count,
            "kind": name,
            "least": min(warm),
            "median": float(np.median(warm)),
            "contacts": int(carry[1].report.contacts),
        }


def steps_told(rows: list[dict[str, Any]]) -> Iterator[str]:
    yield "| robots | kind | least | median | contacts |"
    yield "|--:|---|--:|--:|--:|"
    for row in rows:
        yield f"| {row['robots']} | {row['kind']} | {row['least']:.2f} | {row['median']:.2f} | {row['contacts']} |"


def small(asked: argparse.Namespace) -> Iterator[dict[str, Any]]:
    begin = time.perf_counter()
    for row in oracle.compared(asked.problems):
        yield row._asdict() | {"seconds": time.perf_counter() - begin}


def small_told(rows: list[dict[str, Any]]) -> Iterator[str]:
    yield "| dimensions | rows | problems | without an answer | piqp undecided | differ | filter wrong | answers apart, m/s | filter farther, m/s | rows violated, m/s |"
    yield "|--:|--:|--:|--:|--:|--:|--:|--:|--:|--:|"
    for row in rows:
        counts = " | ".join(f"{row[key]:,}" for key in ("dimension", "rows", "count", "infeasible", "undecided", "differ", "wrong"))
        yield f"| {counts} | {row['apart']:.1e} | {row['farther']:.1e} | {row['violated']:.1e} |"
    yield ""
    yield (
        f"{sum(row['count'] for row in rows):,} problems in {rows[-1]['seconds']:.0f} s. Where piqp runs out of digits, or they differ, a linear program (HiGHS) says whether there "
        "is an answer. *Filter farther*: the most that the filter's answer is farther from the wish than piqp's; since it violates no row, it is the better one "
        "where the two lie apart."
    )


def mujoco(asked: argparse.Namespace) -> Iterator[dict[str, Any]]:
    for count in (20, 100):
        result = consat.run(
            consat.load("drones", [f"count={count}"]), robots="quadrotor", simulator="mujoco", wind=(1.0, 0.5, 0.0), until=30, record=False
        )
        yield ran(f"drones, {count} quadrotors in space, wind of 1.1 m/s", result, alone(Quadrotor(), count, 3))
    yield ran("swap of 8 differential drives", consat.run("swap", simulator="mujoco", until=30), alone(Unicycle(), 8, 2))
    for name, model in (("differential drives", Unicycle()), ("quadrotors, at one height", Quadrotor())):
        yield {"scene": f"swap of 8 {name}, without the filter", "duration": 30.0, "contacts": blind(model, circle(8), 30.0)}


def ran(scene: str, result: Any, alone: float) -> dict[str, Any]:
    motion = result.summary["motion"]
    kept = ("duration", "contacts", "smallest_distance", "satisfied_share_after", "stuck", "unproven")
    since = result.summary["satisfied_from"]["time"]
    return {
        "scene": scene,
        "since": since,
        "times": motion["duration"] / result.summary["seconds"]["run"],
        "alone": alone,
        **{key: motion[key] for key in kept},
    }


def alone(model: Any, count: int, dimension: int) -> float:
    """Times real time of the simulator and its controllers, of robots that rest on a grid."""
    robots = simulated("mujoco", model, count, dimension, [])
    place = np.stack(np.meshgrid(*[np.arange(10.0)] * dimension), axis=-1).reshape(-1, dimension)[:count]
    bodies, rest = robots.simulator.start(place), jax.tree.map(np.asarray, robots.reference.start(jnp.asarray(place)))
    begin = time.perf_counter()
    for _ in range(40):
        bodies = robots.simulator.step(bodies, rest, rest, np.zeros_like(place), dt=DT)
    return 40 * DT / (time.perf_counter() - begin)


def blind(model: Any, scene: tuple[np.ndarray, np.ndarray], seconds: float) -> int:
    """Pairs that touch when everybody heads for its goal without the filter."""
    count, goals = len(scene[0]), jnp.asarray(scene[1])
    drive = Drive(simulated("mujoco", model, count, 2, []), count, 2, DT)
    robots = drive.model

    @jax.jit
    def step(state: Any, memory: Any) -> Any:
        way = goals - robots.place(state)
        length = jnp.linalg.norm(way, axis=1)
        wish = way * (robots.approach(length, DT) / jnp.maximum(length, 1e-9))[:, None]
        after = robots.step(state, robots.command(state, wish, DT), DT)
        return after, drive.observed(after, memory)

    state = robots.start(jnp.asarray(scene[0]))
    memory = drive.start(state)
    for _ in range(round(seconds / DT)):
        state, memory = step(state, memory)
    return int(memory.report.contacts)


def mujoco_told(rows: list[dict[str, Any]]) -> Iterator[str]:
    yield "| scene | s | all constraints from, s | held after | contacts | smallest gap, m | stuck | times real time | simulator alone |"
    yield "|---|--:|--:|--:|--:|--:|--:|--:|--:|"
    for row in rows:
        if "times" not in row:
            yield f"| {row['scene']} | {row['duration']:.0f} | – | – | {row['contacts']} | – | – | – | – |"
            continue
        since = "never" if row["since"] is None else f"{row['since']:.1f}"
        held = "–" if row["satisfied_share_after"] is None else f"{100 * row['satisfied_share_after']:.1f} %"
        yield (
            f"| {row['scene']} | {row['duration']:.0f} | {since} | {held} | {row['contacts']} | {row['smallest_distance']:.3f} | {len(row['stuck'])} | "
            f"{row['times']:.1f} | {row['alone']:.1f} |"
        )
    told = sorted({sentence for row in rows for sentence in row.get("unproven", [])})
    yield ""
    yield f"Conditions of the theorem that did not hold: {'; '.join(told) or 'none'}."


Part = tuple[str, str, Callable[[argparse.Namespace], Iterator[dict[str, Any]]], Callable[[list[dict[str, Any]]], Iterator[str]]]
PARTS: dict[str, Part] = {
    "swaps": (
        "Swaps on a circle",
        (
            "Everybody goes to the opposite side. Unicycles keep a radius of 0.15 m, the body and the steered point ahead of the axle: their circles are wider. "
            f"One QP for all has a row for each pair, and takes part up to {CENTRAL} robots."
        ),
        swaps,
        swaps_told,
    ),
    "crowds": (
        "Random crowds",
        f"{', '.join(map(str, CROWDS[:-1]))} and {CROWDS[-1]} robots, as dense whatever their number.",
        crowds,
        crowds_told,
    ),
    "obstacles": (
        "Among obstacles",
        "Random starts and goals among eight shelves and two pillars; paths are planned, and planned anew, as in `consat run`.",
        obstacles,
        obstacles_told,
    ),
    "steps": (
        "Milliseconds a step",
        (
            f"Everything that a step does for all robots: neighbours, planes, two small problems a robot, rules, the model's step, the report. {CHUNK} steps at a time, "
            "from the start of a random crowd, ten times after compilation."
        ),
        steps,
        steps_told,
    ),
    "oracle": (
        "The small problem against piqp",
        "Random problems of the filter, some without an answer, some with rows that face each other.",
        small,
        small_told,
    ),
    "mujoco": (
        "Bodies in MuJoCo",
        (
            "`--simulator mujoco`: contacts are MuJoCo's. *Times real time* is of the whole run, protocol and filter included, compilation not; *simulator alone* is of the physics and "
            "the controllers, of robots at rest. Smallest gaps are between bodies."
        ),
        mujoco,
        mujoco_told,
    ),
}
"""Of each part its heading, what is measured, the measurement, row by row, and its table."""


def measured(name: str, asked: argparse.Namespace, kept: Path) -> None:
    """Measure a part, and keep each row as it comes."""
    libraries = ("jax", "pyrvo", "piqp", "mujoco-core")
    begin = time.perf_counter()
    part = {
        "date": datetime.datetime.now(tz=datetime.UTC).date().isoformat(),
        "load": round(os.getloadavg()[0], 1),
        "cores": len(os.sched_getaffinity(0)),
        "python": platform.python_version(),
        "versions": {library: version(library) for library in libraries},
        "consat": consat.__version__,
        "whole": False,
        "rows": [],
    }
    for row in PARTS[name][2](asked):
        part["rows"].append(row)
        part["minutes"] = round((time.perf_counter() - begin) / 60, 1)
        print({key: value for key, value in row.items() if key != "ways"}, flush=True)
        keep(kept, name, part)
    part["whole"] = True
    keep(kept, name, part)


def keep(path: Path, name: str, part: dict[str, Any]) -> None:
    known = json.loads(path.read_text()) if path.exists() else {}
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(known | {name: part}, indent=1) + "\n")


def page(parts: dict[str, Any]) -> str:
    told = [PAGE]
    for name, (heading, about, _, table) in PARTS.items():
        if name not in parts or not parts[name]["rows"]:
            continue
        part = parts[name]
        versions = ", ".join(f"{library} {number}" for library, number in part["versions"].items())
        short = "" if part["whole"] else " (cut short)"
        when = f"{part['date']}, {part['cores']} cores, load {part['load']} at the start, {part['minutes']:g} minutes; Python {part['python']}, {versions}, consat {part['consat']}"
        told += [f"## {heading}", about, "\n".join(table(part["rows"]))]
        if name == "obstacles" and "crowds" in parts:
            told.append("![consat's times against ORCA's, and ways among shelves](robots.png)")
            told.append("![eight unicycles on a circle swap places](../figures/swap.gif)")
            told.append("The film: `consat run swap --out swap && consat export swap --to swap.gif`.")
        told.append(f"`python benchmarks/robots.py --part {name}`{short}: {when}.")
    return "\n\n".join(told) + "\n"


def picture(path: Path, crowded: list[dict[str, Any]], cluttered: list[dict[str, Any]]) -> None:
    figure = Figure(figsize=(11, 4.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    ours, theirs = ([row for row in crowded if row["method"] == name] for name in ("consat, points", "ORCA"))
    both = [(a, b) for a, b in zip(ours, theirs, strict=False) if a["time"] and b["time"]]
    pairs = np.array([[b["time"], a["time"]] for a, b in both])
    top = pairs.max() * 1.04
    left.plot([0.9, top], [0.9, top], color="0.6", linewidth=1)
    left.plot([0.9, top], [1.08, 1.2 * top], color="0.6", linewidth=1, linestyle="--")
    touched = np.array([b["contacts"] > 0 for _, b in both])
    left.scatter(*pairs[~touched].T, s=16, color="tab:blue", label="nobody touched")
    left.scatter(*pairs[touched].T, s=16, color="tab:red", label="ORCA's robots touched")
    left.set(xlabel="ORCA", ylabel="consat", xlim=(0.93, top), ylim=(0.93, top), aspect="equal")
    left.set_title("time until all have arrived, over straight-line time;\ndashed: 1.2 times ORCA's", fontsize=10)
    left.legend(loc="lower right", fontsize=8)
    for each in shelves():
        from matplotlib.patches import Circle, Rectangle

        style = {"facecolor": "0.75", "edgecolor": "0.4", "hatch": "///", "linewidth": 0.8}
        if hasattr(each, "radius"):
            right.add_patch(Circle(each.center, each.radius, **style))
        else:
            right.add_patch(Rectangle(each.low, *np.subtract(each.high, each.low), **style))
    record = np.array(next(row["ways"] for row in reversed(cluttered) if row["ways"]))
    for index in range(record.shape[1]):
        (line,) = right.plot(*record[:, index].T, linewidth=0.8, alpha=0.7)
        right.add_patch(Circle(record[0, index], RADIUS, fill=False, edgecolor=line.get_color()))
        right.add_patch(Circle(record[-1, index], RADIUS, color=line.get_color()))
    right.set(aspect="equal", xlabel="m", ylabel="m")
    right.set_title(f"{AMONG} unicycles among shelves, once a second:\nstarts (rings), ways, ends (discs)", fontsize=10)
    figure.savefig(path, dpi=110)


PAGE = """# Robots on their way: consat, ORCA and one QP for all

Discs of radius 0.1 m, 0.5 m/s at most, commands every 0.05 s. A robot has arrived within 0.1 m of its goal; the time is that until all have,
over that which the longest straight way takes. Contacts are pairs that ever overlapped. **consat** is the drive of [robots](../robots.md):
each robot by itself, from measured positions and velocities. **ORCA** is pyrvo, horizon 2 s, 10 neighbours, a little noise against symmetry
(ms: `do_step` alone). **One QP for all** is the Robotarium's barrier certificate with its gain (100, cubed), solved by piqp to 1e-2; nobody
moves when it fails. A path is over the straight line. The numbers are in [robots.json](robots.json)."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--part", nargs="*", choices=PARTS, default=list(PARTS), help="what to measure; nothing: only write the page anew")
    parser.add_argument("--scenes", type=int, default=100, help="random crowds")
    parser.add_argument("--most", type=int, default=1000, help="robots")
    parser.add_argument("--problems", type=int, default=1_000_000, help="of the filter, against piqp")
    parser.add_argument("--out", type=Path, default=Path("docs/benchmarks"), help="folder for robots.md, robots.png and robots.json")
    asked = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    kept = asked.out / "robots.json"
    for name in asked.part:
        measured(name, asked, kept)
    parts = json.loads(kept.read_text())
    if "crowds" in parts and "obstacles" in parts:
        picture(asked.out / "robots.png", parts["crowds"]["rows"], parts["obstacles"]["rows"])
    (asked.out / "robots.md").write_text(page(parts), encoding="utf-8")


if __name__ == "__main__":
    main()
