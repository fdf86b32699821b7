"""Rounds and floats until a team is satisfied: consat's protocols, the paper's sampled flow, gradient methods, and tvopt, side by side.

    python benchmarks/rounds.py [--quick] [--out docs/benchmarks]

Writes ``rounds.md`` and ``rounds.png``. One round is one message over each link in each direction. Satisfied means for good: the first
round after the last one with a margin ≤ 0, at the agents' own positions. tvopt takes part if it can be imported.
"""

from __future__ import annotations

import argparse
import dataclasses
import datetime
import functools
import os
import platform
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import peers
from families import FAMILIES, Problem
from jax import Array
from scipy.optimize import minimize

from consat.certify.certificate import bounds
from consat.certify.optimum import cluster_margins, max_min
from consat.certify.quadratics import values_and_gradients
from consat.engine.round import begin, many_rounds
from consat.engine.rules import HOLD
from consat.engine.world import World, world_of
from consat.faults import Faults
from consat.numerics import Groups, float64, quick_compilation
from consat.problem.objective import Nu, Objective, SmoothingSchedule
from consat.problem.units import Scale, automatic, scale
from consat.protocols import PAIRED, ROUNDS, Rounds
from consat.protocols.estimates import Estimates
from consat.runs.preparation import way_of

CLOSE = 1e-3
"""Of the scale of ψ: how near the optimum counts as there."""
CHUNK = 50
"""Rounds between two looks at whether all is over."""
SMALL = 30
"""Agents; larger teams run until satisfied, whether or not near the optimum, and without `proximal`."""
QUICK = {("case A", 3), ("case C", 3), ("chain", 10), ("chain", 100), ("grid", 10), ("tree", 10), ("ring, apart", 6)}
"""What ``--quick`` runs."""
BOXES = (4.0, 100.0, 1e4)
WEATHERS = tuple((box, loss) for loss in (0.0, 0.1, 0.3) for box in BOXES)
SHOWN = ((4.0, 0.0), (1e4, 0.3))
"""Boxes and losses of the picture, and of the default protocol's table."""
PAPER_STEP = 0.01
"""Of the sampled flow, s: what the design's figures were measured with; reported beside the best."""
RAMPED = 230.0
"""When the paper's ramp of ν_β is over, s."""
NEAR = 0.5
"""Around an optimum: where gradient methods with a constant ν have a chance."""

Report = Callable[[str], None]


class Condition(NamedTuple):
    """Where estimates start (half the side of a box), which part of the messages is lost, and which part of the agents sleeps."""

    box: float
    loss: float
    sleep: float = 0.0


class Measured(NamedTuple):
    """What became of the instances of a problem under one condition; NaN where it didn't happen.

    Attributes:
        satisfied: (S,) rounds to satisfaction for good.
        optimal: (S,) rounds to within `CLOSE` of the best β (of the best margin β̄ for max-min), for good.
        floats: (S,) sent until satisfied.
        rounds: how many were run.
        margin: (S,) the last.
    """

    satisfied: np.ndarray
    optimal: np.ndarray
    floats: np.ndarray
    rounds: int
    margin: np.ndarray

    @property
    def success(self) -> float:
        return float(np.mean(np.isfinite(self.satisfied)))


@dataclass
class Stage:
    """A problem, ready to run: what all protocols share.

    Attributes:
        problem: what.
        copies: local estimates.
        nu: the smoothing.
        size: the team's natural size.
        cluster: (N,) the instance of each agent.
        best: (S,) the best margins; None for teams that are not convex.
        smooth_best: (S,) the best β.
        center: (N, d) where β is best; None for teams that are not convex.
        results: by protocol and condition.
        steps: the best step of others, in words.
        verdict: on an infeasible problem, at the end.
    """

    problem: Problem
    copies: Estimates
    nu: Nu
    size: Scale
    cluster: np.ndarray
    best: np.ndarray | None
    smooth_best: np.ndarray
    center: np.ndarray | None
    results: dict[tuple[str, Condition], Measured] = field(default_factory=dict)
    steps: dict[tuple[str, Condition], str] = field(default_factory=dict)
    verdict: str = ""

    @classmethod
    def of(cls, problem: Problem, *, optima: bool = True) -> Stage:
        """Args: problem: what; optima: whether to find the best of each instance centrally."""
        team = problem.team
        copies, size = Estimates.of(team, "local"), scale(team)
        nu = SmoothingSchedule.of(problem.smoothing or automatic(size)).final
        best, center, smooth = None, None, np.full(problem.seeds, np.nan)
        if problem.convex and optima:
            optimum = max_min(team)
            best = np.asarray(cluster_margins(team, values_and_gradients(team, optimum.positions)[0], copies.cluster))
            center, smooth = _best_smooth(problem, copies.cluster, nu, optimum.positions)
        return cls(problem, copies, nu, size, copies.cluster, best, smooth, center)

    def world(self, *, rough: bool, protocol: Rounds, copies: Estimates) -> World:
        faults = Faults(loss=0.5 if rough else 0.0)
        return world_of(
            self.problem.team, copies, self.nu, self.size, convex=self.problem.convex, faults=faults, body=None, speaks=protocol.speaks
        )

    def layout(self, name: str) -> Estimates:
        """Who holds what with a protocol."""
        return way_of(self.problem.team, name, "local").copies if name in PAIRED else self.copies

    def copies_sent(self) -> np.ndarray:
        """(S,) positions sent in a round, in each instance."""
        return np.bincount(self.cluster[self.copies.holder[self.copies.edges[:, 0]]], minlength=self.problem.seeds)

    def first(self, box: float, seed: int, copies: Estimates | None = None) -> np.ndarray:
        """(C, d) first estimates, uniform in ±box, or for a box of `NEAR` that far around the optimum."""
        copies, random = copies or self.copies, np.random.default_rng([seed, int(box)])
        drawn = random.uniform(-box, box, (copies.count, self.problem.team.dimension))
        return drawn + self.center[copies.position] if box == NEAR and self.center is not None else drawn


def _best_smooth(problem: Problem, cluster: np.ndarray, nu: Nu, first: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The formation with the best β of every instance, centrally, by L-BFGS from the one with the best margin; and these β."""
    observer, groups = Objective.at_positions(problem.team), Groups.of(cluster, problem.seeds)

    @jax.jit
    @jax.value_and_grad
    def fall(x: Array) -> Array:
        return -jnp.sum(_smooth_margins(observer, groups, nu, x.reshape(first.shape)))

    found = minimize(
        lambda x: tuple(np.asarray(part, dtype=float) for part in fall(jnp.asarray(x))),
        first.ravel(), jac=True, method="L-BFGS-B", options={"maxiter": 3000, "maxfun": 4000, "ftol": 1e-13, "gtol": 1e-9},
    )  # fmt: skip
    x = found.x.reshape(first.shape)
    return x, np.asarray(jax.jit(_smooth_margins)(observer, groups, nu, jnp.asarray(x)))


def _smooth_margins(observer: Objective, groups: Groups, nu: Nu, x: Array) -> Array:
    """(S,) β of every instance."""
    return -groups.logsumexp(observer.log_objective(x, nu))[0] / nu.beta


def _look(observer: Objective, groups: Groups, nu: Nu, x: Array) -> tuple[Array, ...]:
    """(S,) margins and smooth margins of every instance, −∞ where a position is not finite."""
    lost = groups.max(jnp.where(jnp.isfinite(x).all(axis=1), 0.0, 1.0)) > 0
    return tuple(jnp.where(lost, -jnp.inf, m) for m in (-groups.max(-observer.agent_margins(x)), _smooth_margins(observer, groups, nu, x)))


@functools.partial(jax.jit, static_argnames=("protocol",), compiler_options=quick_compilation())
def _start(protocol: Rounds, world: World, first: Array, keys: Array) -> Any:
    return jax.vmap(lambda x, key: begin(protocol, world, x, key)[0])(first, keys)


@functools.partial(jax.jit, static_argnames=("protocol",), compiler_options=quick_compilation())
def _go_on(protocol: Rounds, world: World, groups: Groups, now: Any, numbers: Array, loss: Array) -> Any:
    def one(now: Any, loss: Array) -> Any:
        world_ = dataclasses.replace(world, loss=loss)
        now, position = many_rounds(protocol, world_, now, numbers, lambda seen: seen.position)
        return now, jax.lax.map(lambda x: _look(world.observer, groups, world.everyone.nu, x), position, batch_size=CHUNK)

    return jax.vmap(one)(now, loss)


def for_good(good: np.ndarray) -> np.ndarray:
    """(…, T, S) → (…, S): the round from which it stays so (for `HOLD` at least); NaN where it doesn't."""
    rounds = good.shape[-2]
    last_bad = np.where(good.all(axis=-2), -1, rounds - 1 - np.argmax(~good[..., ::-1, :], axis=-2))
    return np.where(last_bad + 1 <= rounds - HOLD, last_bad + 1.0, np.nan)


def _over(satisfied: np.ndarray, optimal: np.ndarray, done: int) -> bool:
    """Whether everything has been reached, and looked at for as long again."""
    last = np.maximum(satisfied.max(initial=0.0), optimal.max(initial=0.0))  # NaN if anything is missing
    return bool(done >= 2 * last + 30)


def measure(stage: Stage, name: str, conditions: Sequence[Condition], cap: int, seed: int = 0) -> None:
    """Run one of our protocols under several conditions, and note what became of it.

    Small teams meet all conditions at once, in one program; large ones one after the other, so that none waits for the slowest.
    """
    if stage.problem.count > SMALL and len(conditions) > 1:
        for condition in conditions:
            measure(stage, name, [condition], cap, seed)
        return
    protocol, problem, copies = ROUNDS[name](), stage.problem, stage.layout(name)
    world = stage.world(rough=name in ("admm", "interior-point"), protocol=protocol, copies=copies)
    groups = Groups.of(stage.cluster, problem.seeds)
    first = np.stack([stage.first(c.box, seed, copies) for c in conditions])
    loss = jnp.asarray([c.loss for c in conditions])
    looked = [jax.jit(jax.vmap(lambda x: _look(world.observer, groups, stage.nu, x)))(jnp.asarray(first[:, copies.own]))]
    margins, smooth = (np.asarray(part)[:, None] for part in looked[0])
    now = _start(protocol, world, jnp.asarray(first), jax.random.split(jax.random.key(seed), len(conditions)))
    done = 0
    while done < cap:
        now, (m, s) = _go_on(protocol, world, groups, now, jnp.arange(done, done + CHUNK, dtype=float), loss)
        margins, smooth = np.concatenate([margins, np.asarray(m)], axis=1), np.concatenate([smooth, np.asarray(s)], axis=1)
        done += CHUNK
        satisfied = for_good(margins > 0)
        value, target = (margins, stage.best) if name == "max-min" else (smooth, stage.smooth_best)
        near = np.zeros_like(value, dtype=bool) if target is None else value >= target - CLOSE * stage.size.psi
        optimal = for_good(near)
        wanted = problem.convex and (problem.count <= SMALL or name == "max-min")
        if _over(satisfied if problem.feasible else np.zeros(1), optimal[:1] if wanted else np.zeros(1), done):
            break
    floats = stage.copies_sent() * (2 * problem.team.dimension + 1 if name == "admm" else problem.team.dimension)
    if world.everyone.interior is not None:
        talker, sizes = np.asarray(world.everyone.interior.talker), np.asarray(world.everyone.interior.plan.floats)
        floats = np.bincount(stage.cluster[talker], weights=sizes, minlength=problem.seeds)
    for k, condition in enumerate(conditions):
        stage.results[name, condition] = Measured(satisfied[k], optimal[k], satisfied[k] * floats, done, margins[k, -1])
    if name == "admm" and not problem.feasible and not stage.verdict:
        x = np.asarray(now.body)[0]
        stage.verdict = bounds(problem.team, x, stage.nu).verdict


# --- what others do ---------------------------------------------------------------------------------------------------------------------


def measure_peers(stage: Stage, boxes: Sequence[float], cap: int, steps: np.ndarray) -> None:
    """The sampled flow and gradient methods, with the paper's ramp and with constant ν, each at its best step for each box."""
    problem = stage.problem
    groups, observer = Groups.of(stage.cluster, problem.seeds), Objective.at_positions(problem.team)
    world = stage.world(rough=False, protocol=ROUNDS["admm"](), copies=stage.copies)  # whoever speaks along links
    boxes = [box for box in boxes if box != NEAR or stage.center is not None]
    first = np.stack([stage.first(box, 0) for box in boxes])
    own = jnp.asarray(stage.copies.own)
    table = peers.lanes(steps, first, stage.nu)
    step, ramped = np.asarray(table.step), np.asarray(table.ramped) > 0
    paper = ramped & (step == PAPER_STEP)
    for method in peers.METHODS:
        lanes, (margins, smooth) = table, (np.zeros((len(table.box), 0, problem.seeds)) for _ in range(2))
        state = peers.start(method, world.everyone, lanes)
        done, chunk, alive = 0, 200, np.arange(len(table.box))
        while done < cap and len(alive):
            state, (m, s) = peers.go_on(
                method, world.everyone, _look, (observer, groups, stage.nu), own, state, lanes, jnp.arange(done, done + chunk, dtype=float)
            )
            full = np.full((2, len(table.box), chunk, problem.seeds), -np.inf)
            full[0, alive], full[1, alive] = (np.where(np.isfinite(part), part, -np.inf) for part in (m, s))
            margins, smooth = np.concatenate([margins, full[0]], axis=1), np.concatenate([smooth, full[1]], axis=1)
            done += chunk
            satisfied = for_good(margins > 0)
            optimal = for_good(smooth >= stage.smooth_best - CLOSE * stage.size.psi)
            ok = np.isfinite(full[0][alive, -1]).any(axis=-1)
            keep = np.flatnonzero(ok)
            if done == chunk or len(keep) < len(alive) / 2:  # lanes that overflowed everywhere are out; each new shape is compiled anew
                state, lanes = jax.tree.map(lambda leaf, keep=keep: leaf[keep], (state, lanes))
                alive, chunk = alive[keep], 1000
            best = [
                _best_lane(lanes_ & np.isin(np.arange(len(table.box)), alive), satisfied)
                for b in range(len(boxes))
                for lanes_ in (table.box == b, (table.box == b) & paper)
                if lanes_[alive].any()
            ]
            whole = [
                min(cap, RAMPED / step[lane]) if ramped[lane] else 0.0 for lane in best
            ]  # a step must be stable to the end of the ramp
            if all(np.isfinite(satisfied[k]).all() and done >= max(2 * satisfied[k].max(), w) for k, w in zip(best, whole, strict=True)):
                break
        for b, box in enumerate(boxes):
            lane = _best_lane(table.box == b, satisfied)
            fastest = _best_lane(table.box == b, optimal)
            floats = stage.copies_sent() * problem.team.dimension * peers.ARRAYS[method] * satisfied[lane]
            condition = Condition(box, 0.0)
            stage.results[method, condition] = Measured(satisfied[lane], optimal[fastest], floats, done, margins[lane, -1])
            stage.steps[method, condition] = f"{step[lane]:.2g}" + (" ramp" if ramped[lane] else "")
            if method == "flow":
                k = int(np.flatnonzero(paper & (table.box == b))[0])
                stage.results["flow 0.01", condition] = Measured(satisfied[k], optimal[k], satisfied[k] * floats, done, margins[k, -1])


def _best_lane(lanes: np.ndarray, rounds: np.ndarray) -> int:
    """Of the lanes allowed, the one where most instances get there, and of these the one that is quickest."""
    reached = np.isfinite(rounds).sum(axis=1)
    median = np.nanmedian(np.where(reached[:, None] > 0, rounds, np.inf), axis=1)
    order = np.lexsort((median, -reached))
    return int(order[lanes[order]][0])


# --- the report -------------------------------------------------------------------------------------------------------------------------


def _median(values: np.ndarray) -> str:
    reached = values[np.isfinite(values)]
    return f"{np.median(reached):.0f}" if len(reached) else "–"


def _reached(measured: Measured) -> str:
    """The median, and the share of the instances that got there, if not all."""
    return _median(measured.satisfied) + (f" ({measured.success:.0%})" if measured.success < 1 else "")


def _thousands(values: np.ndarray) -> str:
    reached = values[np.isfinite(values)]
    return f"{np.median(reached):,.0f}".replace(",", " ") if len(reached) else "–"


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = ["| " + " | ".join(head) + " |", "|" + "|".join("---" if k == 0 else "--:" for k in range(len(head))) + "|"]
    return "\n".join([*lines, *("| " + " | ".join(row) + " |" for row in rows)])


def _box(box: float) -> str:
    return {NEAR: "x* ± 0.5", 1e4: "±1e4"}.get(box, f"±{box:g}")


def _ours(stages: Sequence[Stage]) -> str:
    head = ["problem", "seeds", *(f"{_box(b)}, {loss:.0%} lost" for b, loss in WEATHERS), "floats, ±4", "to the best β, ±4", "success"]
    rows = []
    for stage in stages:
        each = [stage.results.get(("admm", Condition(*c))) for c in WEATHERS]
        got = [m for m in each if m]
        success = f"{np.mean([m.success for m in got]):.1%}" if stage.problem.feasible else stage.verdict
        cells = [_reached(m) if m and stage.problem.feasible else "–" if m else "" for m in each]
        rows.append([
            stage.problem.name, str(stage.problem.seeds), *cells,
            _thousands(got[0].floats), _median(got[0].optimal) if stage.problem.convex else "not convex", success,
        ])  # fmt: skip
    return table(head, rows)


def _default(stages: Sequence[Stage]) -> str:
    head = ["problem", *(f"{_box(b)}, {loss:.0%} lost" for b, loss in SHOWN), "floats, ±4", "success"]
    rows = []
    for stage in stages:
        got = [m for c in SHOWN if (m := stage.results.get(("interior-point", Condition(*c))))]
        if got:
            success = f"{np.mean([m.success for m in got]):.1%}"
            rows.append([stage.problem.name, *map(_reached, got), _thousands(got[0].floats), success])
    return table(head, rows)


def _twins(stages: Sequence[Stage]) -> str:
    head = ["problem", *(f"proximal {_box(b)}" for b in BOXES), "success", "max-min: rounds to 1e-3 of β̄*", "reached", "off β̄* at the end"]
    rows = []
    for stage in stages:
        near = [stage.results.get(("proximal", Condition(b, 0.0))) for b in BOXES]
        exact = stage.results.get(("max-min", Condition(4.0, 0.0)))
        if near[0] is None:
            continue
        cells = [_reached(m) if stage.problem.feasible else "–" for m in near if m]
        success = f"{np.mean([m.success for m in near if m]):.1%}" if stage.problem.feasible else "infeasible"
        if exact is None or stage.best is None:
            rows.append([stage.problem.name, *cells, success, "", "", ""])
            continue
        off = np.max(np.abs(stage.best - exact.margin)) / stage.size.psi
        rows.append([
            stage.problem.name, *cells, success,
            _median(exact.optimal), f"{np.mean(np.isfinite(exact.optimal)):.0%}", f"{off:.1e}",
        ])  # fmt: skip
    return table(head, rows)


def _others(stages: Sequence[Stage], boxes: Sequence[float]) -> str:
    methods = ("flow", "flow 0.01", "tracking", "extra")
    titles = ("sampled flow, best step", f"at h = {PAPER_STEP:g}", "gradient tracking", "EXTRA")
    head = [
        "problem",
        "from",
        "admm",
        *titles,
        "flow ÷ admm",
        f"at h = {PAPER_STEP:g} ÷ admm",
        "floats, flow ÷ admm",
        "best step of the flow",
    ]
    rows = []
    for stage in stages:
        for box in boxes:
            condition = Condition(box, 0.0)
            theirs = [stage.results.get((m, condition)) for m in methods]
            ours = stage.results.get(("admm", condition))
            if ours is None or theirs[0] is None:
                continue
            cells = [f"{_median(m.satisfied)} ({m.success:.0%})" if m and m.success else "never" for m in theirs]
            ratios = _ratio(stage, box), _ratio(stage, box, flow="flow 0.01"), _ratio(stage, box, "floats")
            rows.append([
                stage.problem.name, _box(box), _median(ours.satisfied), *cells,
                *("–" if np.isnan(r) else f"{r:.0f}" if np.isfinite(r) else "∞" for r in ratios),
                stage.steps.get(("flow", condition), "") if theirs[0].success else "",
            ])  # fmt: skip
    return table(head, rows)


def _ratio(stage: Stage, box: float, of: str = "satisfied", flow: str = "flow") -> float:
    """How many times more the sampled flow takes, at its median, counting an instance that is never satisfied as ∞."""
    taken = (getattr(stage.results[m, Condition(box, 0.0)], of) for m in (flow, "admm"))
    theirs, own = (float(np.median(np.where(np.isfinite(rounds), rounds, np.inf))) for rounds in taken)
    return theirs / max(own, 1.0) if np.isfinite(own) else np.nan


def _targets(stages: Sequence[Stage], compared: Sequence[Stage]) -> str:
    rows: list[tuple[str, str, bool]] = []
    feasible = [s for s in compared if s.problem.feasible]
    compared_boxes = sorted({c.box for s in compared for m, c in s.results if m == "flow" and c.box != NEAR})
    for flow, words in (("flow", "at its best step"), ("flow 0.01", f"at h = {PAPER_STEP:g}")):
        for some in dict.fromkeys([*((box,) for box in compared_boxes), tuple(compared_boxes)]):
            ratios = np.array([_ratio(s, box, flow=flow) for s in feasible for box in some])
            lost = int(np.sum(~np.isfinite(ratios)))
            middle, least = float(np.median(ratios)), float(ratios.min())
            shown, smallest = (f"{ratio:.0f}" if np.isfinite(ratio) else "∞" for ratio in (middle, least))
            text = f"median {shown}, least {smallest}; in {lost} of {len(ratios)} cases the flow is not satisfied"
            rows.append((f"≥ 100 × fewer rounds than the flow sampled {words}, from {', '.join(map(_box, some))}", text, middle >= 100))
    for family in ("chain", "grid"):
        for box in BOXES:
            key = "admm", Condition(box, 0.0)
            at = {s.problem.count: s.results[key].satisfied for s in stages if s.problem.family == family and key in s.results}
            if 10 not in at or max(at) == 10:
                continue
            medians = {n: float(np.median(np.where(np.isfinite(v), v, np.inf))) for n, v in at.items()}
            text = ", ".join(f"{n}: {m:.0f}" for n, m in medians.items())
            met = medians[max(at)] <= 1.5 * medians[10]
            rows.append((f"{family}s flat from N = 10 to {max(at)} (at most half as many again), from {_box(box)}", text, met))
    for box in BOXES:
        trees = [s for s in stages if s.problem.family == "tree"]
        if not trees:
            break
        taken = np.concatenate([s.results["admm", Condition(box, 0.0)].satisfied for s in trees])
        allowed = np.concatenate([3 * s.problem.diameters + 20 for s in trees])
        share = np.where(np.isfinite(taken), taken, np.inf) / allowed
        text = (
            f"{np.mean(share <= 1):.0%} of {len(share)} trees; of what is allowed, median {np.median(share):.2f}, worst {share.max():.2f}"
        )
        rows.append((f"≤ 3 × diameter + 20 on random trees, from {_box(box)}", text, bool((share <= 1).all())))
    convex = [s for s in stages if s.problem.convex and s.problem.feasible]
    for loss in (0.0, 0.1, 0.3):
        key = [(s, box, ("admm", Condition(box, loss))) for s in convex for box in BOXES]
        got = [(s, box, s.results[k]) for s, box, k in key if k in s.results]
        runs = np.concatenate([m.satisfied for *_, m in got])
        missed = "; ".join(f"{s.problem.name} from {_box(box)}: {m.success:.0%}" for s, box, m in got if m.success < 1)
        text = f"{np.mean(np.isfinite(runs)):.1%} of {len(runs)} runs" + (f"; missed: {missed}" if missed else "")
        rows.append((f"100 % success on convex feasible problems, every box, {loss:.0%} lost", text, not missed))
    for stage in (s for s in stages if not s.problem.convex):
        runs = np.concatenate([stage.results["admm", Condition(box, 0.0)].satisfied for box in BOXES])
        each = ", ".join(f"{_box(box)}: {stage.results['admm', Condition(box, 0.0)].success:.0%}" for box in BOXES)
        rate = np.mean(np.isfinite(runs))
        rows.append((f"nonconvex ≥ 95 %: {stage.problem.name}", f"{rate:.1%} of {len(runs)} runs ({each})", bool(rate >= 0.95)))
    exact = [(s, s.results["max-min", Condition(4.0, 0.0)]) for s in stages if ("max-min", Condition(4.0, 0.0)) in s.results]
    off = {s.problem.name: float(np.max(np.abs(s.best - m.margin)) / s.size.psi) for s, m in exact if s.best is not None}
    if off:
        worst = max(off, key=lambda name: off[name])
        missed = ", ".join(f"{name} {value:.1e}" for name, value in off.items() if not value <= CLOSE)
        text = f"{len(off)} problems; worst {worst}: {off[worst]:.1e}" + (f"; missed: {missed}" if missed else "")
        rows.append(("max-min within 1e-3 of Clarabel on every convex problem (scale of ψ = 1)", text, not missed))
    return table(["target", "measured", "met"], [(t, m, "yes" if met else "**no**") for t, m, met in rows])


def machine(command: str, seconds: float) -> str:
    packages = ", ".join(f"{name} {version(name)}" for name in ("jax", "numpy", "consat"))
    return (
        f"{datetime.date.today().isoformat()}, {os.cpu_count()} cores ({platform.machine()}), Python {platform.python_version()}, {packages}; "
        f"`{command}`, {seconds / 60:.1f} minutes."
    )


PROSE = """# Rounds to satisfaction

{machine}

One round is one message over every link in each direction. A team is satisfied from the round after the last one in which some constraint,
at the agents' own positions, did not hold. Entries are medians over seeds (instance, starts, first estimates and losses all vary) of those that
got there. All protocols use local estimates, and the same ν throughout a problem. Starts and first estimates are uniform in the box.

![rounds to satisfaction against the size of the team](rounds.png)

## interior-point

Along the links, without the turn to a spanning tree of teams that they do not satisfy in time. Where links form loops and some constraint is
not concave ("apart" below), the default is admm. Success: over both conditions.

{default}

## admm

Rounds to satisfaction. "To the best β": rounds until β stays within 1e-3 (scale of ψ = 1) of the best. Success: over all nine conditions, within
{cap} rounds up to N = 30 and {cap_large} beyond; for infeasible problems the verdict at the end.

{ours}

## proximal and max-min

Without loss; max-min from ±4.

{twins}

## Others

Rounds to satisfaction (share of the instances that got there). Every method runs at its best step, searched on a grid of {steps} from {low:g} to {high:g}, with
the paper's ramp of ν_β and with constant ν, whichever is better, for every problem and box; at most {cap_peers} rounds. The flow is the paper's, by
forward Euler. A start of x* ± 0.5 is the one where gradient methods with a constant ν do not overflow. ∞: never satisfied.

{others}

### Packages

{packages}

## Targets

{targets}
"""


def main() -> None:
    """Measure and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="small teams and few seeds, in less than two minutes")
    parser.add_argument("--out", type=Path, default=Path("docs/benchmarks"))
    parser.add_argument("--only", help="only the problems whose name contains this")
    asked = parser.parse_args()
    began = time.perf_counter()

    def say(text: str) -> None:
        sys.stderr.write(f"{time.perf_counter() - began:6.0f} s  {text}\n")

    stages, compared, boxes, steps, caps = run(say, quick=asked.quick, only=asked.only or "")
    packages = peers.packages(quick=asked.quick)
    say("packages")
    command = "python benchmarks/rounds.py" + (" --quick" if asked.quick else "")
    asked.out.mkdir(parents=True, exist_ok=True)
    text = PROSE.format(
        machine=machine(command, time.perf_counter() - began), ours=_ours(stages), default=_default(stages), twins=_twins(stages), others=_others(compared, boxes),
        targets=_targets(stages, compared), packages=packages, steps=len(steps), low=steps[0], high=steps[-1],
        cap=caps[0], cap_large=caps[1], cap_peers=caps[2],
    )  # fmt: skip
    (asked.out / "rounds.md").write_text(text)
    import picture

    picture.draw(stages, asked.out / "rounds.png")
    sys.stdout.write(text[text.index("## Targets") :])


@float64
def run(
    say: Report, *, quick: bool, only: str = ""
) -> tuple[list[Stage], list[Stage], tuple[float, ...], np.ndarray, tuple[int, int, int]]:
    """Everything: the stages, those on which others were run too, from where, their steps, and the caps on rounds."""
    caps = (400, 200, 4000) if quick else (1000, 400, 10_000)
    conditions = [Condition(*c) for c in WEATHERS]
    clear = [Condition(box, 0.0) for box in BOXES]
    steps = np.sort(np.append(np.geomspace(2e-3, 0.5, 5 if quick else 10), PAPER_STEP))
    boxes = (NEAR, 4.0) if quick else (NEAR, 4.0, 100.0)
    stages, compared = [], []
    for family in FAMILIES:
        for count in family.sizes:
            if only not in f"{family.name} N={count}" or (quick and (family.name, count) not in QUICK):
                continue
            problem = family.at(count, 5 if quick or count > SMALL else 10)
            stage = Stage.of(problem)
            cap = caps[0] if count <= SMALL else caps[1]
            say(f"{problem.name}: reference")
            measure(stage, "admm", conditions, cap)
            say("  admm")
            if problem.feasible:
                measure(stage, "interior-point", [Condition(*c) for c in SHOWN], cap)
                say("  interior-point")
            if count <= SMALL and not (quick and count > 3):
                measure(stage, "proximal", clear, cap)
                say("  proximal")
            if count <= 100 and problem.convex and not (quick and count > 3):
                measure(stage, "max-min", clear[:1], 400)
                say("  max-min")
            stages.append(stage)
            if count <= (3 if quick else 10) or (family.name == "chain" and count <= 30):
                if stage.center is not None:  # as many lanes as before: nothing to compile
                    measure(stage, "admm", [Condition(NEAR, 0.0)] * len(conditions), cap)
                measure_peers(stage, boxes, caps[2], steps)
                compared.append(stage)
                say("  others")
    return stages, compared, boxes, steps, caps


if __name__ == "__main__":
    main()
