"""Rounds to the least violating formation of teams that can't be satisfied: consat's protocols and what others do, side by side.

    python benchmarks/infeasible.py [--quick] [--seeds 3] [--out docs/benchmarks]

Writes ``infeasible.md`` and ``infeasible.png``. One round is one message over each link in each direction. D is how many hops a message needs
across the communication tree. A method has arrived from the round after the last one in which the margin, at the agents' own positions, was
farther than the tolerance from the best margin, which one cone program for the whole team gives.
"""

from __future__ import annotations

import argparse
import itertools
import multiprocessing
import os
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, NamedTuple

import baselines
import matplotlib as mpl
import numpy as np
from baselines import Arrays
from rounds import for_good, machine, table
from scipy.optimize import minimize

import consat as cs
from consat.certify.optimum import max_min
from consat.engine.rules import HOLD
from consat.numerics import float64
from consat.problem.graphs import hops
from consat.problem.objective import Nu, SmoothingSchedule
from consat.problem.units import automatic, scale

mpl.use("Agg")
import matplotlib.pyplot as plt

Report = Callable[[str], None]

BOX = 8.0
"""Half the side of the box in which agents start."""
PLACES = 4.0
"""Half the side of the box in which the formation lies that the constraints are drawn around."""
REACH = 6
"""In a tree, an agent hangs on one of so many before it."""
PLAINLY = 0.05
"""Teams whose best margin is not at least so far below zero are drawn again."""
EXACT, ROUGH = 1e-3, 0.05
"""The tolerances: of max(1, |β̄*|), and of |β̄*|."""
SHAPES = ("tree", "line")
SIZES = (3, 6, 10, 20, 40, 60)
QUICK_SIZES = (3, 10)
LOOK = 100
"""Rounds between two looks at whether a method has arrived."""


class Method(NamedTuple):
    """How a method is called and drawn."""

    title: str
    color: str
    marker: str
    line: str


METHODS: Final[Mapping[str, Method]] = {
    "max-min": Method("consat, max-min: one hop a round", "#000000", "o", "-"),
    "sweeps": Method("the same Newton steps, two sweeps each", "#0072B2", "s", "--"),
    "admm": Method("consat, admm", "#009E73", "^", "-."),
    "dual": Method("dual decomposition", "#D55E00", "D", ":"),
    "subgradient": Method("projected subgradient", "#CC79A7", "v", (0, (5, 1, 1, 1, 1, 1))),  # type: ignore[arg-type]
    "extra": Method("EXTRA on the smooth objective", "#E69F00", "P", (0, (1, 2))),  # type: ignore[arg-type]
    "flow": Method("the paper's flow, sampled", "#56B4E9", "X", (0, (6, 3))),  # type: ignore[arg-type]
}
"""Colours that colour-blind people can tell apart (Okabe, Ito)."""


class Arrived(NamedTuple):
    """What became of a method on one team; NaN where it didn't arrive.

    Attributes:
        exact: rounds to `EXACT`.
        rough: rounds to `ROUGH`.
        off: |β̄ − β̄*|/|β̄*| after the last round, of the lane where it is least.
        steps: Newton steps to `EXACT`, where each takes several rounds.
        floats: in a message.
    """

    exact: float
    rough: float
    off: float
    steps: float = np.nan
    floats: float = np.nan


@dataclass
class Case:
    """A team that can't be satisfied.

    Attributes:
        shape: ``tree`` or ``line``.
        count: N.
        best: β̄*.
        hops: D.
        smooth: the margin of the formation whose smooth margin is best.
        results: by method.
    """

    shape: str
    count: int
    best: float
    hops: int
    smooth: float = np.nan
    results: dict[str, Arrived] = field(default_factory=dict)


def draw(shape: str, count: int, random: np.random.Generator) -> cs.Team:
    """See `instance`."""
    return cs.Team(*instance(shape, count, random), 2)


def instance(shape: str, count: int, random: np.random.Generator, prefix: str = "") -> tuple[list[cs.Agent], list[tuple[str, str]]]:
    """Discs on some agents, a tether or a displacement along every link, around a random formation; noise and squeezed tethers spoil it."""
    places = random.uniform(-PLACES, PLACES, (count, 2))
    squeeze = random.uniform(0.05, 1.0)
    ids = [f"{prefix}a{i}" for i in range(count)]
    parent = [i - 1 if shape == "line" else int(random.integers(max(0, i - REACH), i)) for i in range(1, count)]
    agents = []
    for i in range(count):
        own: list[cs.Constraint] = []
        if i:
            j = parent[i - 1]
            away = places[i] - places[j]
            if random.random() < 0.5:
                own.append(cs.near(ids[j], max(0.3, squeeze * float(np.linalg.norm(away)))))
            else:
                own.append(cs.displacement(ids[j], (away + random.normal(0, 0.5, 2)).tolist(), float(random.uniform(0.3, 0.6))))
        if i in (0, count - 1) or random.random() < 0.4:
            own.append(cs.within((places[i] + random.normal(0, 0.5, 2)).tolist(), float(random.uniform(0.3, 0.8))))
        agents.append(cs.Agent(ids[i], own))
    return agents, [(ids[j], ids[i]) for i, j in enumerate(parent, 1)]


def case(shape: str, count: int, seed: int) -> tuple[Case, cs.Team, np.ndarray]:
    """The first team drawn from a seed that can't be satisfied, and its best formation, (N, d)."""
    random = np.random.default_rng([seed, count, SHAPES.index(shape)])
    while True:
        team = draw(shape, count, random)
        optimum = max_min(team)
        if optimum.exact and optimum.margin < -PLAINLY:
            return Case(shape, count, optimum.margin, hops(count, team.links)), team, optimum.positions


# --- measuring --------------------------------------------------------------------------------------------------------------------------


def arrived(margins: np.ndarray, best: float) -> Arrived:
    """From margins (T, L) of all lanes: each tolerance at the lane that meets it first."""
    away = np.abs(margins - best)
    within = [for_good(away <= tolerance) for tolerance in (EXACT * max(1.0, abs(best)), max(ROUGH * abs(best), EXACT))]
    exact, rough = (float(np.min(rounds, initial=np.inf, where=np.isfinite(rounds))) for rounds in within)
    last = away[-1].min()
    return Arrived(*(rounds if np.isfinite(rounds) else np.nan for rounds in (exact, rough)), float(last / abs(best)))


def follow(rounds: baselines.Rounds, best: float, cap: int) -> Arrived:
    """Run a method until it has arrived and stayed for as long again, or to the cap."""
    margins: list[np.ndarray] = []
    for margin in rounds:
        margins.append(margin)
        if len(margins) % LOOK == 0 and len(margins) > 2 * arrived(np.array(margins), best).exact + 30:
            break
        if len(margins) > cap:
            break
    else:
        margins += [margins[-1]] * HOLD  # a method that ends by itself stays where it is
    return arrived(np.array(margins), best)


def consat(team: cs.Team, best: float, protocol: str, rounds: int, seed: int) -> tuple[Arrived, np.ndarray]:
    """One of consat's protocols, and where the agents started, (N, d)."""
    result = cs.run(team, protocol=protocol, rounds=rounds, start=(-BOX, BOX), seed=seed, record=False)
    found = arrived(np.asarray(result.data["margin"])[:, None], best)
    floats = result.summary["floats_sent"] / result.summary["messages"]
    return found._replace(floats=floats), np.asarray(result.data["position"])[0]


def sweeps(arrays: Arrays, x: np.ndarray, best: float, across: int) -> Arrived:
    """The best of all gains; each step takes two sweeps of `across` hops."""
    steps = [follow(baselines.sweeps(arrays, x, sigma, part), best, baselines.SWEEP_STEPS) for sigma, part in baselines.SWEEP_GAINS]
    exact, rough = (
        min((rounds for each in steps if np.isfinite(rounds := getattr(each, name))), default=np.nan) for name in ("exact", "rough")
    )
    return Arrived(2 * across * exact, 2 * across * rough, min(each.off for each in steps), exact)


def smoothed(arrays: Arrays, x: np.ndarray, nu: Nu) -> float:
    """The margin of the formation with the best smooth margin, found centrally from x, (N, d)."""
    sharp = float(nu.beta)

    def fall(flat: np.ndarray) -> tuple[float, np.ndarray]:
        psi, slope = arrays.psi(flat[:, None], arrays.at_positions)
        exponent = -sharp * psi[:, 0]
        weight = np.exp(exponent - exponent.max())
        gradient = np.bincount(arrays.at_positions.ravel(), (-weight[:, None] / weight.sum() * slope[..., 0]).ravel(), len(flat) + 1)
        return float((exponent.max() + np.log(weight.sum())) / sharp), gradient[:-1]

    found = minimize(fall, x.ravel(), jac=True, method="L-BFGS-B", options={"maxiter": 5000, "maxfun": 8000, "ftol": 1e-14, "gtol": 1e-9})
    return float(arrays.psi(found.x[:, None], arrays.at_positions)[0].min())


@float64
def measure(shape: str, count: int, seed: int, cap: int) -> Case:
    """All methods on one team, from the same starts, (N, d); those on the smooth objective also from near its best formation."""
    one, team, formation = case(shape, count, seed)
    arrays, nu, best = Arrays.of(team), SmoothingSchedule.of(automatic(scale(team))).final, one.best
    one.smooth = smoothed(arrays, formation, nu)
    near = formation + np.random.default_rng(seed).uniform(-baselines.NEAR, baselines.NEAR, formation.shape)
    one.results["max-min"], x = consat(team, best, "max-min", 100 + 8 * one.hops, seed)
    one.results["admm"], _ = consat(team, best, "admm", cap, seed)
    with np.errstate(all="ignore"):  # lanes that overflow are lost, and others go on
        one.results["sweeps"] = sweeps(arrays, x, best, one.hops)
        for name, rounds in (
            ("dual", baselines.dual(arrays, x)),
            ("subgradient", baselines.subgradient(arrays, x)),
            ("extra", baselines.smooth("extra", arrays, (x, near), nu, best)),
            ("flow", baselines.smooth("flow", arrays, (x, near), nu, best)),
        ):
            one.results[name] = follow(rounds, best, cap)
    return one


def run(say: Report, *, sizes: Sequence[int], seeds: int, cap: int) -> list[Case]:
    """All teams, one process a core."""
    cases = []
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # of the processes to come
    teams = itertools.product(range(seeds), sizes, SHAPES)
    with ProcessPoolExecutor(mp_context=multiprocessing.get_context("spawn")) as pool:
        for done in as_completed([pool.submit(measure, shape, count, seed, cap) for seed, count, shape in teams]):
            one = done.result()
            cases.append(one)
            found = ", ".join(f"{name} {result.exact:.0f}" for name, result in one.results.items())
            say(f"{one.shape}, {one.count} agents, D {one.hops}: {found}")
    return sorted(cases, key=lambda one: (SHAPES.index(one.shape), one.count, one.hops, one.best))


# --- the report -------------------------------------------------------------------------------------------------------------------------


def median(values: Sequence[float]) -> float:
    """Counting what didn't arrive as ∞."""
    return float(np.median(np.where(np.isfinite(values), values, np.inf)))


def groups(cases: Sequence[Case]) -> list[tuple[str, int, list[Case]]]:
    """The cases by shape and size."""
    keys = dict.fromkeys((one.shape, one.count) for one in cases)
    return [(*key, [one for one in cases if (one.shape, one.count) == key]) for key in keys]


def _rounds(cases: Sequence[Case], tolerance: str) -> str:
    head = ["teams", "D", "best margin", *(method.title for method in METHODS.values())]
    rows = []
    for shape, count, some in groups(cases):
        cells = []
        for name in METHODS:
            taken = [getattr(one.results[name], tolerance) for one in some]
            got, middle = int(np.isfinite(taken).sum()), median(taken)
            share = f" ({got} of {len(taken)})" if 0 < got < len(taken) else ""
            cells.append(("never" if not got else "–" if np.isinf(middle) else f"{middle:.0f}") + share)
        across, best = (f"{np.median([getattr(one, what) for one in some]):{form}}" for what, form in (("hops", ".0f"), ("best", ".2f")))
        rows.append([f"{shape}s, {count} agents", across, best, *cells])
    return table(head, rows)


def _summary(cases: Sequence[Case]) -> str:
    head = ["method", "arrives to 1e-3", "to 5 %", "rounds to 1e-3 ÷ consat's", "to 5 % ÷ consat's", "off the best margin at the end"]
    rows = []
    for name, method in METHODS.items():
        cells = [method.title]
        for tolerance in ("exact", "rough"):
            cells.append(f"{sum(np.isfinite(getattr(one.results[name], tolerance)) for one in cases)} of {len(cases)}")
        for tolerance in ("exact", "rough"):
            ratio = median([getattr(one.results[name], tolerance) / getattr(one.results["max-min"], tolerance) for one in cases])
            cells.append(f"{ratio:.1f}" if np.isfinite(ratio) else "∞")
        off = 100 * float(np.median([one.results[name].off for one in cases]))
        rows.append([*cells, f"{off:.0f} %" if off >= 10 else f"{off:.2g} %" if off >= 1e-3 else "< 0.001 %"])
    return table(head, rows)


def _law(cases: Sequence[Case], tolerance: str, base: int, slope: int) -> str:
    """How many rounds consat takes against D, and whether that is what the design asks for."""
    taken, across = np.array([(getattr(one.results["max-min"], tolerance), one.hops) for one in cases]).T
    got = np.isfinite(taken)
    fit = np.polyfit(across[got], taken[got], 1) if len(set(across[got])) > 1 else np.full(2, np.nan)
    share = np.where(got, taken, np.inf) / (base + slope * across)
    words = "1e-3" if tolerance == "exact" else "5 %"
    return (
        f"* to {words}: {fit[1]:.0f} + {fit[0]:.1f} D rounds by least squares; of {base} + {slope} D, the design's goal for the median, "
        f"the median takes {np.median(share):.2f} and the 95th percentile {np.quantile(share, 0.95, method='higher'):.2f} (goal: 2)"
    )


def _smoothing(cases: Sequence[Case]) -> str:
    away = np.array([abs(one.smooth - one.best) for one in cases])
    best = np.array([abs(one.best) for one in cases])
    exact, rough = int(np.sum(away <= EXACT * np.maximum(1.0, best))), int(np.sum(away <= np.maximum(ROUGH * best, EXACT)))
    return (
        f"The formation with the best smooth margin, at the ν that consat takes, is within 1e-3 of the best margin on {exact} of {len(cases)} teams "
        f"and within 5 % on {rough}; at the median it is {np.median(away / best):.1%} off. Methods that climb it come to rest there, if they get there."
    )


PROSE = """# Rounds to the least violating formation

{machine}

Teams that can't be satisfied: {shapes} of {sizes} agents, {seeds} of each, with a tether or a displacement along every link, and discs on
some agents. All agents start in ±{box:g}. The best margin β̄* is that of one cone program for the whole team (Clarabel). D is how many hops a
message needs across the communication tree. One round is one message over every link in each direction. A method has arrived from the round
after the last one in which the margin, at the agents' own positions, was farther from β̄* than 1e-3 max(1, |β̄*|), or than 5 % of |β̄*|.
Entries are medians over the seeds, in which a team where a method doesn't arrive counts as ∞. At most {cap} rounds.

![rounds to the least violating formation against the hops across the team](infeasible.png)

## All teams

{summary}

consat's `max-min` takes

{law}

{smoothing}

## Rounds to within 1e-3

{exact}

## Rounds to within 5 %

{rough}

## What was compared

Every method but consat's runs at its best parameters, chosen for every team and tolerance by itself, from what is listed; consat's run with their defaults.

* **consat, max-min**: `consat.run(team, protocol="max-min")`. A message is the quadratic of everything behind its sender: {floats} numbers
  in these teams, {floats_admm} in `admm`.
* **The same Newton steps, two sweeps each**: every step of the same primal-dual interior point is exact for the whole team, which takes one
  sweep up the tree and one down, 2 D rounds (Khoshfetrat Pakazad, Hansson, Andersen, arXiv 1502.06384); {steps} steps at the median. σ in
  {sigmas}, the part of a slack that a step may take in {parts}. The sweep that agrees on the length of a step is not counted.
* **consat, admm**: `consat.run(team, protocol="admm")`, on the smooth objective.
* **Dual decomposition** of the epigraph form, max Σ t_i/N with ψ_ik ≥ t_i and all copies and levels equal: each agent solves its own problem
  exactly, multipliers make neighbours agree. Without a proximal term an agent's own problem has no bound, so it is the predictor-corrector
  method of multipliers (Chen, Teboulle 1994); {duals} weights of that term.
* **Projected subgradient** on the epigraph: mix with the neighbours, raise the level, project on the own constraints (Nedić, Ozdaglar, Parrilo
  2010); {subs} steps, constant or falling as k^−½ or k^−1.
* **EXTRA** (Shi, Ling, Wu, Yin 2015) on the paper's f_i = e^(−ν α_i): {extras} steps, ν as consat takes it and 5 and 25 times
  less, and two starts: from ±{box:g}, where the exponential overflows, and from within ±{near:g} of the best formation.
* **The paper's flow**, sampled by forward Euler: {flows} steps, with and without the paper's ramp of ν_β, the same ν and starts.
"""


def report(cases: Sequence[Case], machine: str, seeds: int, cap: int) -> str:
    sizes = sorted({one.count for one in cases})
    sigmas, parts = (", ".join(f"{value:g}" for value in dict.fromkeys(column)) for column in zip(*baselines.SWEEP_GAINS, strict=True))
    steps = [one.results["sweeps"].steps for one in cases]
    floats, floats_admm = (f"{np.median([one.results[name].floats for one in cases]):.0f}" for name in ("max-min", "admm"))
    return PROSE.format(
        machine=machine, shapes=" and ".join(f"{shape}s" for shape in SHAPES), sizes=", ".join(map(str, sizes)), seeds=seeds, box=BOX,
        near=baselines.NEAR, cap=cap, summary=_summary(cases), smoothing=_smoothing(cases), exact=_rounds(cases, "exact"),
        law="\n".join([_law(cases, "exact", 20, 4), _law(cases, "rough", 15, 3)]), rough=_rounds(cases, "rough"), floats=floats,
        floats_admm=floats_admm, steps=f"{median(steps):.0f}", sigmas=sigmas, parts=parts, duals=len(baselines.DUAL_WEIGHTS),
        subs=len(baselines.SUBGRADIENT_STEPS), extras=len(baselines.EXTRA_STEPS), flows=len(baselines.FLOW_STEPS),
    )  # fmt: skip


def picture(cases: Sequence[Case], path: Path, cap: int) -> None:
    """Args: cases: what was measured; path: of the PNG; cap: on rounds."""
    figure, axes = plt.subplots(2, 2, figsize=(11, 8.2), sharex="col", sharey=True, layout="constrained")
    for row, (tolerance, words, goal) in zip(axes, (("exact", "to 1e-3", (20, 4)), ("rough", "to 5 %", (15, 3))), strict=True):
        for panel, shape in zip(row, SHAPES, strict=True):
            some = [one for one in cases if one.shape == shape]
            far = max(one.hops for one in some)
            _panel(panel, some, tolerance, cap)
            panel.set_title(f"{shape}s, {words}", fontsize=11, loc="left")
            across = np.linspace(2, far, 50)
            panel.plot(across, goal[0] + goal[1] * across, color="#9a9a9a", linewidth=1, zorder=1, label=f"{goal[0]} + {goal[1]} D")
        row[0].set_ylabel("rounds")
    for panel in axes[1]:
        panel.set_xlabel("D, hops across the team")
    handles, labels = axes[0, 0].get_legend_handles_labels()
    goals = [axes[row, 0].lines[-1] for row in (0, 1)]
    handles, labels = [*handles[:-1], goals[0]], [*labels[:-1], "goal: 20 + 4 D to 1e-3, 15 + 3 D to 5 %"]
    figure.legend(handles, labels, loc="outside lower center", ncols=2, frameon=False, fontsize=10, handlelength=3.6)
    figure.savefig(path, dpi=150)
    plt.close(figure)


def _panel(panel: Any, cases: Sequence[Case], tolerance: str, cap: int) -> None:
    """Medians against D; a method whose median doesn't arrive stands in the band above the cap, each on its own height."""
    low, high = 1.35 * cap, 1.35 * cap * 1.38 ** (len(METHODS) - 1)
    panel.axhspan(cap * 1.12, high * 1.25, color="#f1f1f1", zorder=1)
    for height, (name, method) in zip(np.geomspace(high, low, len(METHODS)), METHODS.items(), strict=True):
        points = [
            (np.median([one.hops for one in some]), median([getattr(one.results[name], tolerance) for one in some]))
            for _, _, some in groups(cases)
        ]
        across, rounds = np.array(sorted(points)).T
        there = np.isfinite(rounds)
        style = {"color": method.color, "marker": method.marker, "markersize": 6.5}
        panel.plot(across[there], np.maximum(rounds[there], 1), linestyle=method.line, linewidth=1.8, label=method.title, zorder=3, **style)
        panel.plot(across[~there], np.full((~there).sum(), height), linestyle="none", markerfacecolor="white", zorder=3, **style)
    panel.text(0.015, 0.99, f"not within {cap} rounds", transform=panel.transAxes, fontsize=9, color="#555555", va="top")
    panel.set(xscale="log", yscale="log", ylim=(5, high * 1.25))
    ticks = [2, 3, 5, 10, 20, 40, 60]
    panel.set_xticks(ticks, [str(tick) for tick in ticks])
    heights = [rounds for rounds in (10, 30, 100, 300, 1000) if rounds < cap] + [cap]
    panel.set_yticks(heights, [str(rounds) for rounds in heights])
    panel.minorticks_off()
    panel.grid(color="#e4e4e4", linewidth=0.8)
    panel.set_axisbelow(True)
    panel.spines[["top", "right"]].set_visible(False)


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="small teams and one seed, in less than two minutes")
    parser.add_argument("--seeds", type=int, default=3, help="teams of each shape and size")
    parser.add_argument("--out", type=Path, default=Path("docs/benchmarks"))
    asked = parser.parse_args()
    began = time.perf_counter()

    def say(text: str) -> None:
        sys.stderr.write(f"{time.perf_counter() - began:6.0f} s  {text}\n")

    sizes, seeds, cap = (QUICK_SIZES, 1, 500) if asked.quick else (SIZES, asked.seeds, 2000)
    cases = run(say, sizes=sizes, seeds=seeds, cap=cap)
    command = "python benchmarks/infeasible.py" + (" --quick" if asked.quick else f" --seeds {seeds}")
    asked.out.mkdir(parents=True, exist_ok=True)
    text = report(cases, machine(command, time.perf_counter() - began), seeds, cap)
    (asked.out / "infeasible.md").write_text(text)
    picture(cases, asked.out / "infeasible.png", cap)
    sys.stdout.write(text[text.index("## All teams") : text.index("## What was compared")])


if __name__ == "__main__":
    main()
