"""Certificates: proven bounds on the best margin that any formation of a team can have, and the resulting verdict.

Let ψ_k be concave and λ ≥ 0 with Σ λ = 1. For each formation x that is better than x̂, β̄(x) ≤ Σ λ_k ψ_k(x). This sum is concave, so

    β̄(x) ≤ q(z) + ∇q(z)·(x − z) ≤ q(z) + Σ_i ‖∇_i q(z)‖ (R_i + ‖z_i − x̂_i‖),    q = Σ λ_k ψ_k,

for ANY point z, where R_i bounds ‖x_i − x̂_i‖ for all better formations (`levels`). The bound is valid for any λ and z, so no solver has to
be trusted: λ and z only decide how tight it is. z is the maximiser of q by Newton's method, exact for quadratics. The λ tried are softmax
weights at x̂ for several ν, those at points found by a central ascent (`refine`), and those given by the caller. Constraints that are not
concave get weight 0: if the others cannot hold together, neither can all. Each cluster has its own bounds; those of the team are the
smallest.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from consat.certify.conic import normalised, units
from consat.certify.levels import radii, with_tangents
from consat.certify.optimum import Optimum, cluster_margins, max_min, middle
from consat.certify.quadratics import Expansion, Floats, Ints, expand, shape_of
from consat.numerics import float64, on_device
from consat.problem.graphs import clusters
from consat.problem.objective import Nu, Objective, evaluate, weigh
from consat.problem.team import Team

Verdict = Literal["feasible", "infeasible", "undecided"]

RUNGS = 4.0 ** np.arange(0, 7)
"""Values of ν times the scale of ψ. Small ones give weight to every constraint, large ones only to the worst."""
LARGE = 200_000
"""Above this many coordinates only a part of the team around its worst constraint is certified; see `_about_the_worst`."""
STEPS = 8
"""Largest distance of the agents of that part from the worst constraint, counted in constraints."""
MOST_TAKEN = 2000
"""The part stops growing when it has more agents than this."""
BLEND = 1e-3
"""Fraction of the softest weights mixed into the weights of each rung. Weights that underflow to 0 leave agents without curvature."""
REFINEMENT = 4.0 ** np.arange(0, 8)
"""As `RUNGS`, for the central ascent `_Proof.climb`."""
CLIMB = 12
"""Largest number of Newton steps at each ν of the central ascent."""
DENSE = 60
"""Up to this many coordinates a dense factorisation is faster than a sparse one."""
EPS = float(np.finfo(float).eps)
ROUNDINGS = 64
"""Allowance for rounding errors within one term of a sum, in units of `EPS` times the size of the term. Each further term adds 1."""
BINDING = 1e-3
"""A multiplier below this does not count as binding."""


@dataclass(frozen=True)
class Certificate:
    """Bounds on β̄*, the best margin that any formation of the team can have.

    Attributes:
        lower: lower bound: β̄ at the given formation. +∞ for a team without constraints.
        upper: proven upper bound; None if there is none.
        multipliers: (M,) λ that prove `upper`. They sum to 1 within each cluster for which a bound is proven.
        clusters: (C, 2) lower and upper bound of each cluster; +∞ where there are no constraints or nothing is proven.
    """

    lower: float
    upper: float | None
    multipliers: Floats
    clusters: Floats

    @property
    def verdict(self) -> Verdict:
        """``feasible`` if the given formation satisfies all constraints, ``infeasible`` if `upper` ≤ 0, else ``undecided``."""
        return "feasible" if self.lower > 0 else "infeasible" if self.upper is not None and self.upper <= 0 else "undecided"

    @property
    def binding(self) -> Ints:
        """Indices of the constraints with λ above `BINDING`, the largest first."""
        heavy = np.flatnonzero(self.multipliers > BINDING)
        return heavy[np.argsort(-self.multipliers[heavy], kind="stable")]


@float64
def bounds(team: Team, positions: Floats, nu: Nu | None = None, refine: bool = True, multipliers: Floats | None = None) -> Certificate:
    """Certify a formation.

    Args:
        team: the team.
        positions: (N, d) formation x̂, length.
        nu: smoothing of a run; its weights at x̂ are tried, too.
        refine: whether to tighten the upper bound by a central ascent from x̂. Without it, the cost is about a dozen evaluations of a team.
        multipliers: (M,) further weights to try, such as those of `consat.certify.optimum.max_min`.
    """
    x = np.asarray(positions, dtype=float)
    if not len(team.owner):
        return Certificate(np.inf, None, np.zeros(0), np.full((team.count, 2), np.inf))
    if x.size > LARGE and np.isfinite(x).all():
        return _about_the_worst(team, x, nu, refine)
    with np.errstate(over="ignore", invalid="ignore"):
        model = expand(team, x) if np.isfinite(x).all() else None
        lower = -np.inf if model is None else float(model.value.min())
        if model is not None and lower == -np.inf:  # upper bounds hold for any expansion point
            model = expand(team, middle(team))
        if model is None or not np.isfinite(model.value).all():
            return Certificate(-np.inf, None, np.zeros(len(team.owner)), np.zeros((0, 2)))
        proof = _Proof(team, model)
        proof.ladder(nu, multipliers)
        if refine:
            proof.climb()
    upper = float(proof.upper.min())
    return Certificate(lower, upper if np.isfinite(upper) else None, proof.best, np.stack([proof.margins, proof.upper], axis=1))


def judged(team: Team) -> tuple[Optimum, Certificate]:
    """The best formation found by central optimization, and a certificate of the team. Refined if the formation may not be the best."""
    best = max_min(team)
    return best, bounds(team, best.positions, refine=not best.exact, multipliers=best.multipliers)


def _about_the_worst(team: Team, x: Floats, nu: Nu | None, refine: bool) -> Certificate:
    """Certify a large team through a part around its worst constraint: an upper bound for some of the constraints holds for all."""
    values = np.asarray(evaluate(Objective.at_positions(team), on_device(x)))
    if not np.isfinite(values).all():
        return Certificate(-np.inf, None, np.zeros(len(values)), np.zeros((0, 2)))
    mine = np.zeros(team.count, dtype=bool)
    mine[team.owner[int(np.argmin(values))]] = True
    for _ in range(STEPS):
        if np.count_nonzero(mine) > MOST_TAKEN:
            break
        for family in team.families:
            mine[family.agents[mine[family.agents].any(axis=1)]] = True
    agents = np.flatnonzero(mine)
    part, numbers = team.part(agents)
    found = bounds(part, x[agents], nu, refine)
    lower = float(values.min())
    multipliers = np.zeros(len(values))
    multipliers[numbers] = found.multipliers
    cluster = clusters(team)
    margins = cluster_margins(team, values, cluster)
    uppers = np.full(len(margins), np.inf)
    uppers[cluster[agents[np.unique(clusters(part), return_index=True)[1]]]] = found.clusters[:, 1]
    upper = None if found.upper is None else max(found.upper, lower)
    return Certificate(lower, upper, multipliers, np.stack([margins, uppers], axis=1))


class _Proof:
    """The best upper bound of each cluster so far, and the λ that prove it.

    Attributes:
        cluster: (N,) cluster of each agent.
        group: (M,) cluster of each constraint.
        count: C, the number of clusters.
        concave: (M,) whether a constraint is proven concave.
        exact: whether all concave constraints are quadratic.
        model: expansion of the concave constraints about x̂.
        margins: (C,) margin at x̂.
        psi: (M,) scale of ψ in the cluster of each constraint.
        radius: (N,) bound on the distance of better formations from x̂, length.
        rounding: (M,) relative allowance for rounding errors in values.
        roughness: (N,) relative allowance for rounding errors in gradients.
        upper: (C,) best upper bound so far.
        best: (M,) λ that prove it.
    """

    def __init__(self, team: Team, model: Expansion) -> None:
        shape, self.cluster = shape_of(team), clusters(team)
        self.team, self.group, self.count = team, self.cluster[team.owner], int(self.cluster.max()) + 1
        self.concave, self.exact = shape.concave, bool((shape.quadratic | ~shape.concave).all())
        self.model = model.keep(self.concave)
        self.margins = cluster_margins(team, model.value, self.cluster)
        unit = units(self.model, self.group, self.count)
        self.psi = unit.psi[self.group]
        known, lower = self.model, self.margins[self.group]
        if not self.exact:
            known, lower = with_tangents(team, known, lower, self.concave & ~shape.quadratic, float(unit.length.max()))
        self.radius = radii(known, lower, self.cluster)
        self.rounding = EPS * (ROUNDINGS + np.bincount(self.group, minlength=self.count))[self.group]
        degree = np.zeros(team.count)
        for family in team.families:
            degree += np.bincount(family.agents.ravel(), minlength=team.count)
        self.roughness = EPS * (ROUNDINGS + degree)
        self.upper = np.full(self.count, np.inf)
        self.best = np.zeros(len(self.group))

    def weights(self, values: Floats, nu: Floats | float) -> Floats:
        """(M,) softmax weights of the concave constraints within each cluster."""
        exponent = np.where(self.concave & np.isfinite(values), -nu * values, -np.inf)
        top = np.full(self.count, -np.inf)
        np.maximum.at(top, self.group, exponent)
        return normalised(np.exp(exponent - np.where(np.isfinite(top), top, 0.0)[self.group]), self.group, self.count)

    def ladder(self, nu: Nu | None, multipliers: Floats | None) -> None:
        """Try weights at x̂: softmax weights over `RUNGS`, those of a run with smoothing `nu`, and given `multipliers`."""
        soft = self.weights(self.model.value, 1.0 / self.psi)
        candidates = [(1 - BLEND) * self.weights(self.model.value, rung / self.psi) + BLEND * soft for rung in RUNGS]
        if nu is not None:
            own = np.asarray(weigh(Objective.at_positions(self.team), on_device(self.model.at), nu)[1])
            candidates.append(normalised(np.where(self.concave, own, 0.0), self.group, self.count))
        if multipliers is not None:
            candidates.append(normalised(np.where(self.concave, multipliers, 0.0), self.group, self.count))
        for weights in candidates:
            self.consider(self.model, weights)

    def climb(self) -> None:
        """Try weights at maximisers of β for increasing ν, found by Newton's method from x̂ or, where β is larger, from `middle`."""
        model = self.model
        central = expand(self.team, middle(self.team)).keep(self.concave)
        soft = 1.0 / self.psi
        ahead = self.smooth(central.value, soft) > self.smooth(model.value, soft)
        if ahead.any():
            model = expand(self.team, np.where(ahead[self.cluster][:, None], central.at, model.at)).keep(self.concave)
        for rung in REFINEMENT:
            nu = rung / self.psi
            for _ in range(CLIMB):
                weights = self.weights(model.value, nu)
                step, promise = self.newton(model, weights, nu)
                if not promise.any():
                    break
                model, moved = self.line_search(model, step, promise, rung)
                if not moved:
                    break
            self.consider(model, self.weights(model.value, nu))

    def newton(self, model: Expansion, weights: Floats, nu: Floats) -> tuple[Floats, Floats]:
        """(N, d) Newton step for β, and (C,) slope of β along it in each cluster; 0 where no gain is left."""
        slope = model.gradient(weights)
        jacobian = model.jacobian()
        bend = -model.hessian(weights) + (jacobian.T @ (sparse.diags_array(nu * weights) @ jacobian))
        step = _solve(bend, slope.ravel(), 1e-12).reshape(slope.shape)
        promise = np.bincount(self.cluster, np.sum(slope * step, axis=1), minlength=self.count)
        psi = np.ones(self.count)
        psi[self.group] = self.psi
        return step, np.where(promise > 1e-14 * psi, promise, 0.0)

    def line_search(self, model: Expansion, step: Floats, promise: Floats, rung: float) -> tuple[Expansion, bool]:
        """Halve the step of each cluster until β increases enough. Returns the new expansion and whether any cluster moved."""
        nu, length = rung / self.psi, np.where(promise > 0, 1.0, 0.0)
        before = self.smooth(model.value, nu)
        for _ in range(30):
            after = expand(self.team, model.at + length[self.cluster][:, None] * step).keep(self.concave)
            value = self.smooth(np.where(np.isfinite(after.value), after.value, -np.inf), nu)
            short = (length > 0) & ~(value >= before + 0.1 * length * promise - ROUNDINGS * EPS * np.abs(before))
            if not short.any():
                return after, bool((length > 0).any())
            length = np.where(short, 0.5 * length, length)
        return model, False

    def smooth(self, values: Floats, nu: Floats) -> Floats:
        """(C,) β of each cluster's concave constraints."""
        low = cluster_margins(self.team, np.where(self.concave, values, np.inf), self.cluster)
        base = np.where(np.isfinite(low), low, 0.0)
        total = np.bincount(self.group, np.where(self.concave, np.exp(-nu * (values - base[self.group])), 0.0), minlength=self.count)
        sharp = np.ones(self.count)
        sharp[self.group] = nu
        return np.where(total > 0, low - np.log(np.where(total > 0, total, 1.0)) / sharp, low)

    def consider(self, model: Expansion, weights: Floats) -> None:
        """Update the bound of each cluster with the one that λ proves, at z = the expansion point and at the maximisers of q."""
        self.settle(model, np.zeros(model.at.shape), weights)
        bend, slope = -model.hessian(weights), model.gradient(weights)
        damping = 1e-14
        for _ in range(4):
            step = _solve(bend, slope.ravel(), damping).reshape(slope.shape)
            self.settle(model, step, weights)
            if not (np.linalg.norm(step, axis=1) > 10 * self.radius).any():
                break
            damping *= 1e4  # almost no curvature in some direction: damp the step, better formations are within `radius`

    def settle(self, model: Expansion, step: Floats, weights: Floats) -> None:
        """Update the bound of each cluster with the one that λ proves for z = model.at + step."""
        if not self.exact and step.any():
            model, step = expand(self.team, model.at + step).keep(self.concave), np.zeros_like(step)
        values, slope = model.values(step), model.gradient(weights, step)
        away = np.linalg.norm(model.at + step - self.model.at, axis=1)
        size, rough = _sizes(model, step, weights)
        left = np.linalg.norm(slope, axis=1) + self.roughness * rough
        reach = np.where(left > 0, left * np.where(left > 0, self.radius + away, 0.0), 0.0)
        terms = weights * (values + self.rounding * size)
        bound = np.bincount(self.group, np.where(weights > 0, terms, 0.0), minlength=self.count)
        bound += np.bincount(self.cluster, reach, minlength=self.count)
        total = np.bincount(self.group, weights, minlength=self.count)
        unknown = (
            np.bincount(self.group, (weights > 0) & ~model.known, minlength=self.count) > 0
        )  # a constraint without an expansion proves nothing
        bound = np.where((total > 0.5) & ~unknown & ~np.isnan(bound), np.maximum(bound, self.margins), np.inf)
        better = bound < self.upper
        self.upper = np.where(better, bound, self.upper)
        self.best = np.where(better[self.group], weights, self.best)


def _sizes(model: Expansion, step: Floats, weights: Floats) -> tuple[Floats, Floats]:
    """(M,) sums of the absolute terms of each ψ, and (N,) of Σ λ∇ψ. Rounding errors are relative to these."""
    size, rough = np.abs(model.value), np.zeros(model.size)
    far, flat = np.abs(model.at).ravel(), np.abs(step).ravel()
    for block in model.blocks:
        bend = np.matmul(np.abs(block.hessian), (far + flat)[block.columns][..., None])[..., 0]
        slope = np.abs(block.gradient) + bend
        size[block.number] += np.sum(np.abs(block.gradient) * far[block.columns] + slope * flat[block.columns], axis=1)
        rough += np.bincount(block.columns.ravel(), (weights[block.number][:, None] * slope).ravel(), minlength=model.size)
    return size, np.sqrt(np.sum(rough.reshape(model.at.shape) ** 2, axis=1))


def _solve(bend: sparse.csc_array, slope: Floats, damping: float) -> Floats:
    """(bend + δI)⁻¹ slope, with δ = damping times the largest diagonal entry; 0 where the result is not finite."""
    diagonal = bend.diagonal()
    largest = float(diagonal.max(initial=0.0))
    if not largest > 0:
        return np.zeros_like(slope)
    if len(slope) <= DENSE:
        dense = bend.toarray()
        dense[np.diag_indices(len(slope))] += damping * largest
        try:
            step = np.linalg.solve(dense, slope)
        except np.linalg.LinAlgError:
            return np.zeros_like(slope)
    else:
        damped = bend + sparse.diags_array(np.full(len(slope), damping * largest))
        step = splu(damped.tocsc(), permc_spec="MMD_AT_PLUS_A").solve(slope)
    return np.where(np.isfinite(step), step, 0.0)
