"""Robots that swap places and cross random crowds: consat, ORCA (pyrvo), and one central QP for all as the Robotarium has it (piqp).

python benchmarks/robots.py [--quick] [--out docs/benchmarks]     # pip install pyrvo piqp
python benchmarks/robots.py --oracle 1000000                      # the filter's small problem against piqp
"""

from __future__ import annotations

import argparse
import datetime
import platform
import time
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import piqp
import scipy.sparse as sp
from matplotlib.figure import Figure
from pyrvo import RVOSimulator
from scipy.spatial import cKDTree

import consat
from consat.robots import Drive, Planner, Point, Quadrotor, Unicycle, box, disc
from consat.robots.filter import nearest

RADIUS, SPEED, DT = 0.1, 0.5, 0.05
GAIN = 100.0
"""Of the Robotarium's barrier certificate, γ h³, its default."""
TOUCH = -1e-6
"""Robots touch where their gap is below that, m: pyrvo computes in float32."""


@dataclass
class Outcome:
    """Of one scene: time until all have arrived (None: never), over the straight-line time; smallest gap, m; pairs that touched; path
    over straight line; robots that have not arrived; ms a step."""

    time: float | None
    gap: float
    contacts: int
    path: float
    left: int
    step: float


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
"""Steps at a time; paths are planned anew after each."""


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
        planner = Planner(drive.map, float(drive.size.max())) if planned else None

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

        return drive, planner, chunk

    def __call__(self, starts, goals, record=None):
        drive, planner, chunk = self._compiled(*starts.shape, bool(self.obstacles))
        state = drive.model.start(jnp.asarray(starts))
        memory, target, path = drive.start(state), jnp.asarray(goals), jnp.zeros(len(starts))
        steps, spent, limit = 0, [], limit_of(starts, goals)
        paths = None
        while steps * DT < limit:
            if planner is not None:
                paths = jnp.asarray(planner.paths(np.asarray(drive.model.place(state)), goals))
                paths = jnp.pad(paths, ((0, 0), (0, 16 - paths.shape[1]), (0, 0)), mode="edge")
                memory = memory._replace(waypoint=jnp.zeros_like(memory.waypoint))
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
        outcome = Outcome(
            steps * DT * SPEED / straight.max() if arrived.all() else None,
            float(report.smallest_distance),
            int(report.contacts) + int(report.collisions),
            float(np.mean(np.asarray(path) / straight)),
            int((~arrived).sum()),
            1e3 * float(np.median(spent)),
        )
        outcome.clearance, outcome.stuck = float(report.clearance), drive.stuck(state, memory, target)
        return outcome


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


def oracle(count: int) -> str:
    """Random problems of up to 8 rows, some of them infeasible or flat against each other: the filter's answers and piqp's."""
    rng, worst, differ, infeasible = np.random.default_rng(0), 0.0, 0, 0
    compiled = jax.jit(nearest)
    begin, done = time.perf_counter(), 0
    while done < count:
        dimension, rows, block = 2 + done // 5000 % 2, 8, min(5000, count - done)
        normals = rng.normal(size=(block, rows, dimension))
        normals[:, 1] = np.where(rng.random((block, 1)) < 0.1, -normals[:, 0], normals[:, 1])
        normals /= np.linalg.norm(normals, axis=2)[..., None]
        least, wish = rng.uniform(-0.5, 0.15, (block, rows)), rng.normal(size=(block, dimension))
        found, there = map(np.asarray, compiled(wish, normals, least, np.full(block, 1e3)))
        for index in range(block):
            solver = piqp.DenseSolver()
            settings = solver.settings
            settings.eps_abs, settings.eps_rel, settings.eps_duality_gap_abs, settings.eps_duality_gap_rel = 1e-11, 0.0, 1e-12, 0.0
            solver.setup(np.eye(dimension), -wish[index], None, None, normals[index], least[index], np.full(rows, 1e30))
            status = solver.solve()
            infeasible += status == piqp.PIQP_PRIMAL_INFEASIBLE
            if (status == piqp.PIQP_PRIMAL_INFEASIBLE) == there[index]:
                differ += 1
            elif status == piqp.PIQP_SOLVED:  # else it ran out of digits
                worst = max(worst, float(np.abs(solver.result.x - found[index]).max()))
        done += block
    return (
        f"{done:,} random problems in 2 and 3 dimensions, {infeasible:,} of them infeasible: the filter and piqp differ on {differ} in whether "
        f"there is an answer, and elsewhere by at most {worst:.1e} m/s ({time.perf_counter() - begin:.0f} s)."
    )


def said(outcome: Outcome) -> str:
    when = "never" if outcome.time is None else f"{outcome.time:.2f}"
    left = f" ({outcome.left} left)" if outcome.left else ""
    return f"{when}{left} | {outcome.contacts} | {1e3 * outcome.gap:+.3f} | {outcome.path:.2f} | {outcome.step:.2f}"


def swaps(counts: list[int], central_up_to: int) -> list[str]:
    rows = [
        "| scene | method | time over straight-line time | contacts | smallest gap, mm | path | ms a step |",
        "|---|---|--:|--:|--:|--:|--:|",
    ]
    for count in counts:
        scene = circle(count)
        ways = {"consat, points": Consat(Point(RADIUS, SPEED)), "ORCA": orca}
        if count <= central_up_to:
            ways["one QP for all"] = central
        for name, way in ways.items():
            rows.append(f"| circle of {count} | {name} | {said(way(*scene))} |")
            print(rows[-1], flush=True)
        wide = circle(count, 1.6)
        rows.append(f"| circle of {count}, 1.6 times as wide | consat, unicycles | {said(Consat(Unicycle(RADIUS, SPEED))(*wide))} |")
        print(rows[-1], flush=True)
    return rows


def crowds(counts: list[int], seeds: int) -> tuple[list[str], dict[str, list[Outcome]]]:
    found: dict[str, list[Outcome]] = {"consat, points": [], "ORCA": []}
    drive = Consat(Point(RADIUS, SPEED))
    for count in counts:
        for seed in range(seeds):
            scene = scattered(count, seed)
            found["consat, points"].append(drive(*scene))
            found["ORCA"].append(orca(*scene))
        print(count, "robots done", flush=True)
    rows = [
        "| method | scenes | all arrived | contacts | smallest gap, mm | time: mean | 95 % | worst | path |",
        "|---|--:|--:|--:|--:|--:|--:|--:|--:|",
    ]
    for name, outcomes in found.items():
        times = np.array([outcome.time or np.inf for outcome in outcomes])
        rows.append(
            f"| {name} | {len(outcomes)} | {np.isfinite(times).sum()} | {sum(outcome.contacts for outcome in outcomes)} | "
            f"{1e3 * min(outcome.gap for outcome in outcomes):+.3f} | {times[np.isfinite(times)].mean():.3f} | "
            f"{np.quantile(times, 0.95, method='lower'):.2f} | {times.max():.2f} | {np.mean([outcome.path for outcome in outcomes]):.3f} |"
        )
    ratio = [a.time / b.time for a, b in zip(found["consat, points"], found["ORCA"], strict=True) if a.time and b.time]
    rows.append("")
    rows.append(
        f"consat's time over ORCA's, scene by scene: mean {np.mean(ratio):.3f}, median {np.median(ratio):.3f}, worst {max(ratio):.2f}."
    )
    return rows, found


def shelves() -> list:
    """Shelves with a pillar between them."""
    boxes = [box([x, y], [x + 0.6, y + 2.0]) for x in (-4.5, -1.5, 1.5, 4.5) for y in (-4.0, 1.0)]
    return [*boxes, disc([0.3, 0.0], 0.5), disc([-3.0, -0.6], 0.4)]


def among(count: int, seeds: int, model) -> tuple[list[Outcome], np.ndarray]:
    drive = Consat(model, shelves())
    clear, outcomes = drive._compiled(count, 2, True)[0].map, []
    for seed in range(seeds):
        rng = np.random.default_rng(seed)
        places = []
        for _ in range(2):
            points = apart_from(rng, 4 * count, 6.5, 2, 0.5)
            free = np.asarray(clear.signed_distance(jnp.asarray(points))) > 0.3
            places.append(points[free][:count])
        record = [places[0]]
        outcomes.append(drive(*places, record=record))
    return outcomes, np.array(record)


def among_table(count: int, seeds: int) -> tuple[list[str], np.ndarray]:
    rows = [
        "| robots | scenes | all arrived | contacts, with robots or obstacles | smallest gap, mm | clearance, mm | time: mean | worst | ms a step |",
        "|---|--:|--:|--:|--:|--:|--:|--:|--:|",
    ]
    for name, model in {"points": Point(RADIUS, SPEED), "unicycles": Unicycle(RADIUS, SPEED)}.items():
        outcomes, record = among(count, seeds, model)
        times = [outcome.time for outcome in outcomes if outcome.time]
        rows.append(
            f"| {count} {name} | {len(outcomes)} | {len(times)} | {sum(each.contacts for each in outcomes)} | {1e3 * min(each.gap for each in outcomes):+.3f} | "
            f"{1e3 * min(each.clearance for each in outcomes):+.3f} | {np.mean(times):.2f} | {max(times):.2f} | {np.median([each.step for each in outcomes]):.2f} |"
        )
        print(rows[-1], flush=True)
    return rows, record


def steps(counts: list[int]) -> list[str]:
    rows = ["| robots | kind | ms a step | contacts |", "|--:|---|--:|--:|"]
    models = {"points": Point(RADIUS, SPEED), "unicycles": Unicycle(RADIUS, SPEED), "quadrotors, at one height": Quadrotor(RADIUS, SPEED)}
    for count in counts:
        for name, model in models.items():
            scene = scattered(count, 0, scale=1.0 if name == "points" else 1.8)
            drive, _, chunk = Consat(model)._compiled(count, 2, False)
            state = drive.model.start(jnp.asarray(scene[0]))
            carry, spent = (state, drive.start(state)), []
            for _ in range(4):
                begin = time.perf_counter()
                carry = jax.block_until_ready(chunk(*carry, jnp.asarray(scene[1]), None, jnp.zeros(count)))[:2]
                spent.append(time.perf_counter() - begin)
            rows.append(f"| {count} | {name} | {1e3 * np.median(spent[1:]) / CHUNK:.2f} | {int(carry[1].report.contacts)} |")
            print(rows[-1], flush=True)
    return rows


def picture(path: Path, found: dict[str, list[Outcome]], record: np.ndarray) -> None:
    figure = Figure(figsize=(11, 4.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    ours, theirs = found["consat, points"], found["ORCA"]
    pairs = np.array([[b.time, a.time] for a, b in zip(ours, theirs, strict=True) if a.time and b.time])
    top = pairs.max() * 1.04
    left.plot([0.9, top], [0.9, top], color="0.6", linewidth=1)
    left.plot([0.9, top], [1.08, 1.2 * top], color="0.6", linewidth=1, linestyle="--")
    touched = np.array([b.contacts > 0 for a, b in zip(ours, theirs, strict=True) if a.time and b.time])
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
    for index in range(record.shape[1]):
        (line,) = right.plot(*record[:, index].T, linewidth=0.8, alpha=0.7)
        right.add_patch(Circle(record[0, index], RADIUS, fill=False, edgecolor=line.get_color()))
        right.add_patch(Circle(record[-1, index], RADIUS, color=line.get_color()))
    right.set(aspect="equal", xlabel="m", ylabel="m")
    right.set_title("30 unicycles among shelves: starts (rings), ways, ends (discs)", fontsize=10)
    figure.savefig(path, dpi=110)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="fewer swaps")
    parser.add_argument("--seeds", type=int, default=20, help="random crowds of each size")
    parser.add_argument("--oracle", type=int, help="only compare so many small problems with piqp")
    parser.add_argument("--out", type=Path, help="folder for robots.md and robots.png")
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    if arguments.oracle:
        print(oracle(arguments.oracle))
        return
    begin, seeds = time.perf_counter(), arguments.seeds
    swapped = swaps([8, 20, 50] if arguments.quick else [8, 20, 50, 100], 20 if arguments.quick else 50)
    crowded, found = crowds([10, 20, 35, 50, 70], seeds)
    print(*crowded, sep="\n", flush=True)
    cluttered, record = among_table(30, max(2, seeds // 2))
    timed = steps([100, 1000])
    compared = oracle(10_000)
    print(compared)
    if arguments.out:
        picture(arguments.out / "robots.png", found, record)
        page = PAGE.format(
            date=datetime.datetime.now(tz=datetime.UTC).date(),
            versions=", ".join(f"{name} {version(name)}" for name in ("jax", "pyrvo", "piqp")),
            python=platform.python_version(),
            consat=consat.__version__,
            command=f"python benchmarks/robots.py --seeds {seeds}" + (" --quick" if arguments.quick else ""),
            minutes=(time.perf_counter() - begin) / 60,
            swaps="\n".join(swapped),
            crowds="\n".join(crowded),
            clutter="\n".join(cluttered),
            steps="\n".join(timed),
            oracle=compared,
        )
        (arguments.out / "robots.md").write_text(page, encoding="utf-8")


PAGE = """# Robots on their way: consat, ORCA and one QP for all

{date}, 2 cores (shared with other work), Python {python}, {versions}, consat {consat}; `{command}`, {minutes:.1f} minutes.

Discs of radius 0.1 m, 0.5 m/s at most, commands every 0.05 s. A robot has arrived within 0.1 m of its goal; the time is that until all have,
over that which the longest straight way takes. Contacts are pairs that ever overlapped. **consat** is the drive of [robots](../robots.md):
each robot by itself, from measured positions and velocities. **ORCA** is pyrvo, horizon 2 s, 10 neighbours, a little noise against symmetry
(ms: `do_step` alone). **One QP for all** is the Robotarium's barrier certificate with its gain (100, cubed), solved by piqp to 1e-2; nobody
moves when it fails. A path is over the straight line.

## Swaps on a circle

Everybody goes to the opposite side.

{swaps}

Unicycles keep a radius of 0.15 m, the body and the steered point ahead of the axle: their circles are wider.

## Random crowds

10, 20, 35, 50 and 70 robots, as dense whatever their number.

{crowds}

![consat's times against ORCA's, and ways among shelves](robots.png)

## Among obstacles

Random starts and goals among eight shelves and two pillars; paths are planned again every second.

{clutter}

## Milliseconds a step

Everything that a step does for all robots: neighbours, planes, two small problems a robot, rules, the model's step, the report.

{steps}

## The small problem against piqp

{oracle} `python benchmarks/robots.py --oracle 1000000` compares a million.
"""

if __name__ == "__main__":
    main()
