"""Newton's method for both saddle-point equations of `consat.protocols.local.proximal`, for the agents of one chunk.

For a fixed σ the first equation is the gradient of a strongly convex function of y, and L(y(σ)) − σ decreases in σ. So Newton's method on
both equations, with a line search on the first and a bracket on the second, converges globally. For ψ that are not concave, the Hessian is
made positive definite where it is not, and the bracket still finds a stationary point.
"""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from consat.numerics import add_up
from consat.protocols.local.proximal.hessians import dot
from consat.protocols.local.proximal.lanes import Expanded, Lanes

MOST_ITERATIONS = 200
SHARPEN = 4.0
"""Factor by which the sharpness is raised each time the problem with the present sharpness is solved."""
LONGEST_STEP = 3.0
"""Largest increase of σ in one step where y depends on σ; the linear model of y(σ) is not valid beyond."""
STRONGEST = 1e12
"""Upper bound on the ratio of e^σ ∇²L to κ. Beyond, only the agent's own constraints matter, and σ is not increased any more."""
UNSEARCHED = 2
"""Largest number of steps without line search in `solve_most`."""
SCALES = (1.0, 0.5, 0.2, 0.05, 0.01, 0.002)
"""Step lengths that the line search tries."""
SHORT = (1e-3, 1e-4, 1e-5, 1e-6, 1e-8)
"""Additional step lengths where the step may leave the domain of a ψ."""


class Guess(NamedTuple):
    """Starting point or solution of the solver.

    Attributes:
        y: (n, d, A) positions.
        sigma: (A,) σ, logarithm of the multiplier.
        sharpness: (A,) sharpness of the soft minimum, in (0, 1].
    """

    y: Array
    sigma: Array
    sharpness: Array


class Precision(NamedTuple):
    """Stopping rule.

    Attributes:
        tolerance: of both equations: relative to the terms of the first, absolute on ln f in the second. If None, the solver stops after
            the first step that starts near the solution (one step for an agent that starts near).
    """

    tolerance: float | None


class _Search(NamedTuple):
    """State of the iteration. As `Guess` with y of shape (N, A); `low` and `high`, (A,), are the bracket of σ; `stiffness`, (n, A), is the
    mean diagonal of ∇²f over the coordinates of each row."""

    y: Array
    sigma: Array
    sharpness: Array
    low: Array
    high: Array
    stiffness: Array
    iterations: Array
    done: Array


class _Ahead(NamedTuple):
    """Newton step in y.

    Attributes:
        descend: (N, A) the step for the present multiplier.
        follow: (N, A) its derivative with respect to σ.
    """

    descend: Array
    follow: Array

    def to(self, change: Array) -> Array:
        """(N, A) the step in y when σ changes by `change`, (A,)."""
        return self.descend + self.follow * jnp.where(change < 0, jnp.exp(change) - 1.0, change)[None]


class _Here(NamedTuple):
    """Quantities of one iteration.

    Attributes:
        model: second-order expansion of L.
        diagonal: (N, A) diagonal of ∇²L.
        ceiling: (A,) upper bound on σ.
        sigma: (A,) σ.
        multiplier: (A,) e^σ.
        pull: (N, A) κ (y − v), first term of the first equation.
        push: (N, A) e^σ ∇L, second term of the first equation.
        ahead: Newton step.
        decrement: (A,) Newton decrement of the first equation.
        near: (A,) whether y solves the first equation for this σ, up to a fraction of the residual of the second equation.
    """

    model: Expanded
    diagonal: Array
    ceiling: Array
    sigma: Array
    multiplier: Array
    pull: Array
    push: Array
    ahead: _Ahead
    decrement: Array
    near: Array

    def wanted(self, drop: Array) -> Array:
        """(A,) the σ that solves both equations to first order. Its increase is limited to the validity of the linear model.

        Args:
            drop: (A,) change of L by the step `ahead.descend`, to first order.
        """
        gap, slope = self.model.level - self.sigma, self.model.slope
        left, reach = gap + drop, jnp.maximum(-dot(slope, self.ahead.follow), 0.0)
        most = jnp.minimum(left, jnp.log(1.0 + jnp.maximum(left, 0.0) / (reach + jnp.finfo(left.dtype).tiny)))
        return self.sigma + jnp.minimum(left / (1.0 + reach), jnp.maximum(LONGEST_STEP, most))


class Found(NamedTuple):
    """Result of the solver.

    Attributes:
        guess: the solutions, which are the starting point of the next proximal step.
        stiffness: (n, A) mean diagonal of ∇²f at the solution, over the coordinates of each row.
        iterations: (A,) number of iterations.
        done: (A,) whether the iteration of each agent has ended.
    """

    guess: Guess
    stiffness: Array
    iterations: Array
    done: Array


def solve(
    lanes: Lanes, v: Array, kappa: Array, guess: Guess, precision: Precision, skip: Array | None = None
) -> Found:  # fmt: skip
    """Solve the proximal step of the agents of a chunk.

    Args:
        lanes: their objectives.
        v: (n, d, A) centre of the quadratic term.
        kappa: (n, A) weights κ > 0.
        guess: starting point.
        precision: stopping rule.
        skip: (A,) agents that need no result.
    """
    task = _Task.of(lanes, v, kappa, precision)
    start = task.start(guess)
    if skip is not None:
        start = start._replace(done=skip)
    return task.found(jax.lax.while_loop(lambda at: jnp.any(~at.done), task.step, start))


def solve_most(lanes: Lanes, v: Array, kappa: Array, guess: Guess, precision: Precision) -> Found:
    """Cheap first steps of `solve`, without line search and bracket, for a `Precision` without tolerance. They end after `UNSEARCHED`
    steps, or when half of the agents are done; the others are not done, but closer to the solution. Arguments as in `solve`."""
    task = _Task.of(lanes, v, kappa, precision)

    def goes_on(at: tuple[Array, _Search]) -> Array:
        number, search = at
        return (number < UNSEARCHED) & (2 * jnp.sum(~search.done) > len(search.done))

    start = jnp.asarray(0), task.start(guess)
    return task.found(jax.lax.while_loop(goes_on, lambda at: (at[0] + 1, task.plain_step(at[1])), start)[1])


class _Task(NamedTuple):
    """The arguments of `solve`, with v and κ of shape (N, A). `shape` is (n, d)."""

    lanes: Lanes
    v: Array
    kappa: Array
    shape: tuple[int, int]
    precision: Precision

    @classmethod
    def of(cls, lanes: Lanes, v: Array, kappa: Array, precision: Precision) -> _Task:
        n, d, count = v.shape
        return cls(lanes, v.reshape(n * d, count), jnp.repeat(kappa, d, axis=0, total_repeat_length=n * d), (n, d), precision)

    def start(self, guess: Guess) -> _Search:
        count = self.v.shape[1]
        infinity = jnp.full(count, jnp.inf, self.v.dtype)
        y = guess.y.reshape(self.v.shape)
        if self.lanes.batch.partial:  # agents outside the domain of a ψ start at v
            y = jnp.where(self.lanes.outside(self.lanes.violations(guess.y))[None], self.v, y)
        nothing = jnp.zeros((self.shape[0], count)), jnp.zeros(count, int), jnp.zeros(count, bool)
        return _Search(y, guess.sigma, guess.sharpness, -infinity, infinity, *nothing)

    def found(self, at: _Search) -> Found:
        return Found(Guess(at.y.reshape(*self.shape, -1), at.sigma, at.sharpness), at.stiffness, at.iterations, at.done)

    def level(self, y: Array, sharpness: Array) -> Array:
        return self.lanes.level(y.reshape(*self.shape, -1), sharpness)

    def step(self, at: _Search) -> _Search:
        """One Newton step in every lane that is not done."""
        here = self.look(at)
        model, ahead, sigma, multiplier, near = here.model, here.ahead, here.sigma, here.multiplier, here.near
        gap, ceiling = model.level - sigma, here.ceiling

        # while `near` is false, only y moves, for a fixed multiplier; then both move, with σ inside the bracket
        # the bracket is narrowed only where the sign of the gap is certain
        drop = dot(model.slope, ahead.descend)
        certain = near & (jnp.abs(drop) <= 0.3 * jnp.abs(gap))
        low = jnp.where(certain & (gap > 0), jnp.maximum(at.low, sigma), at.low)
        high = jnp.where(certain & (gap < 0), jnp.minimum(at.high, sigma), at.high)
        wanted = here.wanted(drop)
        bracketed = jnp.isfinite(low) & jnp.isfinite(high) & ((wanted < low) | (wanted > high))
        wanted = jnp.minimum(jnp.where(bracketed, 0.5 * (low + high), wanted), ceiling)
        together = ahead.to(wanted - sigma)
        if self.lanes.batch.partial:
            to = self.search_within(at, multiplier, jnp.where(near[None], together, ahead.descend), near)
        else:
            alone = jax.lax.cond(
                jnp.any(~near & ~at.done), lambda: self.search(at, multiplier, ahead.descend), lambda: at.y + ahead.descend
            )  # fmt: skip
            to = jnp.where(near[None], at.y + together, alone)

        sharp = at.sharpness >= 1.0
        met = (sigma >= ceiling - 1e-6) & (gap > 0)
        done, last = at.done, near & sharp
        if self.precision.tolerance is not None:
            settled, equal = self.settled(at, here)
            met |= equal
            done, last = at.done | (settled & met & sharp), jnp.zeros_like(sharp)
        sharpen = near & ((jnp.abs(gap) <= 3.0) | met) & ~sharp
        moves, rises = ~done, near & ~done
        tired = at.iterations + 1 >= MOST_ITERATIONS
        if self.lanes.batch.partial:  # outside the domain there is no solution to find
            tired |= model.level == jnp.inf
        return _Search(
            y=jnp.where(moves[None], to, at.y),
            sigma=jnp.where(rises, wanted, jnp.where(at.done, at.sigma, sigma)),
            sharpness=jnp.where(sharpen & moves, self.sharper(at.sharpness), at.sharpness),
            low=jnp.where(sharpen, -jnp.inf, low),
            high=jnp.where(sharpen, jnp.inf, high),
            stiffness=jnp.where(at.done[None], at.stiffness, self.stiffness(here)),
            iterations=jnp.where(at.done, at.iterations, at.iterations + 1),
            done=done | last | tired,
        )

    def sharper(self, sharpness: Array) -> Array:
        """(A,) the next sharpness. For partial ψ it rises faster from very small values, which very steep ψ cause."""
        next_ = SHARPEN * sharpness
        return jnp.minimum(jnp.maximum(next_, jnp.sqrt(sharpness)) if self.lanes.batch.partial else next_, 1.0)

    def plain_step(self, at: _Search) -> _Search:
        """One Newton step in every lane that is not done. In lanes that start near the solution it is the last step, and y and σ move. In
        the others only y moves."""
        here = self.look(at)

        def decide() -> tuple[Array, Array, Array]:
            wanted = jnp.minimum(here.wanted(dot(here.model.slope, here.ahead.descend)), here.ceiling)
            last = here.near & (at.sharpness >= 1.0)
            return jnp.where(last, wanted, here.sigma), last, ~at.done & jnp.isfinite(here.decrement)

        # always true: `cond` keeps the compiler from fusing `decide` into later code, where it would be recomputed for every coordinate
        sigma, last, moves = jax.lax.cond(jnp.any(~at.done), decide, lambda: (at.sigma, at.done, at.done))
        y = at.y + here.ahead.to(sigma - here.sigma)
        return at._replace(
            y=jnp.where(moves[None], y, at.y),
            sigma=jnp.where(at.done, at.sigma, sigma),
            stiffness=jnp.where(at.done[None], at.stiffness, self.stiffness(here)),
            done=at.done | last,
        )

    def look(self, at: _Search) -> _Here:
        """Expand L at the present point and compute the Newton step."""
        model = self.lanes.expand(at.y.reshape(*self.shape, -1), at.sharpness)
        diagonal = model.bend.diagonal()
        mean = add_up(jnp.abs(diagonal)) / len(at.y)
        ceiling = jnp.log(STRONGEST * (add_up(self.kappa) / len(at.y)) / (mean + jnp.finfo(at.y.dtype).tiny))
        sigma = jnp.minimum(at.sigma, ceiling)
        multiplier = jnp.exp(sigma)
        pull, push = self.kappa * (at.y - self.v), multiplier[None] * model.slope
        found = model.bend.solve(self.kappa, multiplier, jnp.stack([-(pull + push), -push], axis=1))
        ahead = _Ahead(found[:, 0], found[:, 1])
        gap = model.level - sigma
        decrement = -dot(pull + push, ahead.descend)
        bent = decrement
        if self.precision.tolerance is None:  # count only the curvature of L along the step: the κ term is exactly quadratic
            bent = jnp.abs(decrement - dot(self.kappa, ahead.descend**2))
        near = bent <= 0.2 * multiplier * jnp.maximum(1.0, 0.3 * jnp.abs(gap))
        return _Here(model, diagonal, ceiling, sigma, multiplier, pull, push, ahead, decrement, near)

    def stiffness(self, here: _Here) -> Array:
        """(n, A) mean diagonal of ∇²f over the coordinates of each row."""
        bent = jnp.abs(here.diagonal + here.model.slope**2).reshape(*self.shape, -1)
        return here.multiplier[None] * (add_up(jnp.moveaxis(bent, 1, 0)) / self.shape[1])

    def search(self, at: _Search, multiplier: Array, descend: Array) -> Array:
        """(N, A) the point y + scale · `descend` with the smallest value of ½ κ ‖y − v‖² + e^σ L(y), over the step lengths `SCALES`."""

        def worth(scale: Array) -> Array:
            y = at.y + scale * descend
            return 0.5 * add_up(self.kappa * (y - self.v) ** 2) + multiplier * self.level(y, at.sharpness)

        scales = jnp.array(SCALES)
        worths = jax.vmap(worth)(scales)
        best = jnp.argmin(jnp.where(jnp.isnan(worths), jnp.inf, worths), axis=0)
        return at.y + scales[best][None] * descend

    def search_within(self, at: _Search, multiplier: Array, step: Array, near: Array) -> Array:
        """(N, A) as `search`, for ψ with a bounded domain. Lanes near the solution take the longest step that stays inside the domain."""

        def level(scale: Array) -> tuple[Array, Array]:
            y = at.y + scale * step
            level = self.level(y, at.sharpness)
            worth = 0.5 * add_up(self.kappa * (y - self.v) ** 2) + multiplier * level
            return level < jnp.inf, jnp.where(worth < jnp.inf, worth, jnp.inf)

        scales = jnp.array((*SCALES, *SHORT, 0.0))
        inside, worths = jax.vmap(level)(scales)
        best = jnp.where(near, jnp.argmax(inside, axis=0), jnp.argmin(worths, axis=0))
        return at.y + scales[best][None] * step

    def settled(self, at: _Search, here: _Here) -> tuple[Array, Array]:
        """(A,) whether the first equation holds, and (A,) whether the second holds, within the tolerance and the rounding error."""
        pull, push, slope = here.pull, here.push, here.model.slope
        residual, gap = pull + push, here.model.level - here.sigma
        eps, tolerance = 8 * jnp.finfo(at.y.dtype).eps, self.precision.tolerance or 0.0
        rounding = eps * (jnp.abs(at.y) + jnp.abs(self.v))
        blur = self.kappa * rounding + here.multiplier[None] * here.model.bend.absolute(rounding)
        terms = jnp.sqrt(dot(pull, pull)) + jnp.sqrt(dot(push, push))
        settled = jnp.sqrt(dot(residual, residual)) <= tolerance * terms + jnp.sqrt(dot(blur, blur))
        return settled, jnp.abs(gap) <= tolerance + eps * jnp.abs(at.sigma) + dot(jnp.abs(slope), rounding)


def cold(lanes: Lanes, v: Array, kappa: Array) -> Guess:
    """Starting point without a previous solution: y = v, the multiplier after one Newton step from there, and the sharpness at which the
    soft minimum is smooth over the spread of the constraints at v.

    Args:
        lanes: the objectives.
        v: (n, d, A) centre of the quadratic term.
        kappa: (n, A) weights κ.
    """
    tiny = jnp.finfo(v.dtype).tiny
    sharpness = lanes.bluntest(lanes.violations(v))
    model = lanes.expand(v, sharpness)
    reach = add_up(model.slope**2 / jnp.repeat(kappa, v.shape[1], axis=0, total_repeat_length=len(model.slope)))
    height = model.level
    sigma = jnp.minimum(height, jnp.log1p(jnp.maximum(height, 0.0)) - jnp.log(jnp.maximum(reach, tiny)))
    if lanes.batch.partial:  # outside the domain L is +∞
        sigma, sharpness = jnp.where(jnp.isfinite(sigma), sigma, 0.0), jnp.where(sharpness > 0.0, sharpness, 1.0)
    return Guess(v, sigma, sharpness)
