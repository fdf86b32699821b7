"""The saddle point of `consat.protocols.local.proximal`, by Newton's method on both its equations, for the agents of one chunk.

For a fixed σ the first equation is the gradient of a strongly convex function of y, and L(y(σ)) − σ falls in σ: Newton on both together,
with a line search on the first and a bracket on the second, cannot miss. For ψ that are not concave the curvature is made positive where it
is not, and the bracket still finds a stationary point.
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
"""Factor by which the soft minimum is sharpened each time its blunter version is solved."""
LONGEST_STEP = 3.0
"""σ rises by at most this much at a time where y answers to it: beyond, the linear model of y says nothing."""
STRONGEST = 1e12
"""Where the multiplier outweighs κ by this much, an agent already does all it can for its own constraints, and σ stays."""
UNSEARCHED = 2
"""Steps of a chunk that go without a line search."""
SCALES = (1.0, 0.5, 0.2, 0.05, 0.01, 0.002)
"""Parts of a step that a line search tries."""
SHORT = (1e-3, 1e-4, 1e-5, 1e-6, 1e-8)
"""What else it tries where a ψ may end on the way."""


class Guess(NamedTuple):
    """Where solvers stand: (n, d, A) their rows, (A,) ln of the multiplier, and (A,) the sharpness reached."""

    y: Array
    sigma: Array
    sharpness: Array


class Precision(NamedTuple):
    """When to stop.

    Attributes:
        tolerance: of both equations: relative to the terms of the first, and on ln f of the second; if None, the first step that begins
            within reach of the solution is the last, so that whoever begins there takes one.
    """

    tolerance: float | None


class _Search(NamedTuple):
    """As `Guess`, but (N, A) for y; the bracket of σ, and (n, A) the mean diagonal of ∇²f over the coordinates of each row."""

    y: Array
    sigma: Array
    sharpness: Array
    low: Array
    high: Array
    stiffness: Array
    iterations: Array
    done: Array


class _Ahead(NamedTuple):
    """Newton's step in y: (N, A) for the multiplier as it is, and what it gains for each unit that σ rises."""

    descend: Array
    follow: Array

    def to(self, change: Array) -> Array:
        """(N, A) the step in y for a change of σ."""
        return self.descend + self.follow * jnp.where(change < 0, jnp.exp(change) - 1.0, change)[None]


class _Here(NamedTuple):
    """Where solvers stand: L to second order, its diagonal, what σ cannot exceed, σ and e^σ, the two forces of the first equation,
    Newton's step and decrement, and whether y is settled for this σ to a fraction of what the second equation lacks."""

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
        """(A,) the σ that solves both equations to first order; `drop`: what the step in y takes off L. It rises by no more than the linear
        model is good for."""
        gap, slope = self.model.level - self.sigma, self.model.slope
        left, reach = gap + drop, jnp.maximum(-dot(slope, self.ahead.follow), 0.0)
        most = jnp.minimum(left, jnp.log(1.0 + jnp.maximum(left, 0.0) / (reach + jnp.finfo(left.dtype).tiny)))
        return self.sigma + jnp.minimum(left / (1.0 + reach), jnp.maximum(LONGEST_STEP, most))


class Found(NamedTuple):
    """Answers.

    Attributes:
        guess: the solutions, where the next step begins.
        stiffness: (n, A) the mean diagonal of ∇²f there over the coordinates of each row.
        iterations: (A,) how many it took.
        done: (A,) whether these are the answers.
    """

    guess: Guess
    stiffness: Array
    iterations: Array
    done: Array


def solve(
    lanes: Lanes, v: Array, kappa: Array, guess: Guess, precision: Precision, skip: Array | None = None
) -> Found:  # fmt: skip
    """The prox of the agents of a chunk.

    Args:
        lanes: their objectives.
        v: (n, d, A) the points to stay near.
        kappa: (n, A) > 0 how near.
        guess: where to begin.
        precision: when to stop.
        skip: (A,) who needs no answer.
    """
    task = _Task.of(lanes, v, kappa, precision)
    start = task.start(guess)
    if skip is not None:
        start = start._replace(done=skip)
    return task.found(jax.lax.while_loop(lambda at: jnp.any(~at.done), task.step, start))


def solve_most(lanes: Lanes, v: Array, kappa: Array, guess: Guess, precision: Precision) -> Found:
    """The first steps of `solve`, without its searches and brackets, at a fraction of its cost, until most of the chunk are within reach of
    the solution, which is all that a `Precision` without tolerance asks of them. The others are not done, but nearer."""
    task = _Task.of(lanes, v, kappa, precision)

    def goes_on(at: tuple[Array, _Search]) -> Array:
        number, search = at
        return (number < UNSEARCHED) & (2 * jnp.sum(~search.done) > len(search.done))

    start = jnp.asarray(0), task.start(guess)
    return task.found(jax.lax.while_loop(goes_on, lambda at: (at[0] + 1, task.plain_step(at[1])), start)[1])


class _Task(NamedTuple):
    """What a solver has to do; as the arguments of `solve`, but (N, A) for v and κ."""

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
        if self.lanes.batch.partial:  # who is outside begins at v
            y = jnp.where(self.lanes.outside(self.lanes.violations(guess.y))[None], self.v, y)
        nothing = jnp.zeros((self.shape[0], count)), jnp.zeros(count, int), jnp.zeros(count, bool)
        return _Search(y, guess.sigma, guess.sharpness, -infinity, infinity, *nothing)

    def found(self, at: _Search) -> Found:
        return Found(Guess(at.y.reshape(*self.shape, -1), at.sigma, at.sharpness), at.stiffness, at.iterations, at.done)

    def level(self, y: Array, sharpness: Array) -> Array:
        return self.lanes.level(y.reshape(*self.shape, -1), sharpness)

    def step(self, at: _Search) -> _Search:
        """One step of Newton in every lane that is not done."""
        here = self.look(at)
        model, ahead, sigma, multiplier, near = here.model, here.ahead, here.sigma, here.multiplier, here.near
        gap, ceiling = model.level - sigma, here.ceiling

        # y alone, for this multiplier, until that much is settled to a fraction of the gap …
        # … then both at once, σ within a bracket that only certain signs may narrow
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
        if self.lanes.batch.partial:  # outside there is nothing to be solved
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
        """(A,) the next sharpness; where some ψ was so steep that it is next to nothing, it rises faster."""
        next_ = SHARPEN * sharpness
        return jnp.minimum(jnp.maximum(next_, jnp.sqrt(sharpness)) if self.lanes.batch.partial else next_, 1.0)

    def plain_step(self, at: _Search) -> _Search:
        """A step of Newton in every lane that is not done, and the last of those that begin it within reach of the solution; y alone moves
        where they don't."""
        here = self.look(at)

        def decide() -> tuple[Array, Array, Array]:
            wanted = jnp.minimum(here.wanted(dot(here.model.slope, here.ahead.descend)), here.ceiling)
            last = here.near & (at.sharpness >= 1.0)
            return jnp.where(last, wanted, here.sigma), last, ~at.done & jnp.isfinite(here.decrement)

        # a branch that is always taken, since its results are stored: fused, they would be computed again for every coordinate
        sigma, last, moves = jax.lax.cond(jnp.any(~at.done), decide, lambda: (at.sigma, at.done, at.done))
        y = at.y + here.ahead.to(sigma - here.sigma)
        return at._replace(
            y=jnp.where(moves[None], y, at.y),
            sigma=jnp.where(at.done, at.sigma, sigma),
            stiffness=jnp.where(at.done[None], at.stiffness, self.stiffness(here)),
            done=at.done | last,
        )

    def look(self, at: _Search) -> _Here:
        """What there is to know where solvers stand."""
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
        if self.precision.tolerance is None:  # where one step is to be enough, count only how L bends along it: κ is quadratic anyway
            bent = jnp.abs(decrement - dot(self.kappa, ahead.descend**2))
        near = bent <= 0.2 * multiplier * jnp.maximum(1.0, 0.3 * jnp.abs(gap))
        return _Here(model, diagonal, ceiling, sigma, multiplier, pull, push, ahead, decrement, near)

    def stiffness(self, here: _Here) -> Array:
        """(n, A) the mean diagonal of ∇²f over the coordinates of each row."""
        bent = jnp.abs(here.diagonal + here.model.slope**2).reshape(*self.shape, -1)
        return here.multiplier[None] * (add_up(jnp.moveaxis(bent, 1, 0)) / self.shape[1])

    def search(self, at: _Search, multiplier: Array, descend: Array) -> Array:
        """Where along a step the function whose gradient the first equation is, is least."""

        def worth(scale: Array) -> Array:
            y = at.y + scale * descend
            return 0.5 * add_up(self.kappa * (y - self.v) ** 2) + multiplier * self.level(y, at.sharpness)

        scales = jnp.array(SCALES)
        worths = jax.vmap(worth)(scales)
        best = jnp.argmin(jnp.where(jnp.isnan(worths), jnp.inf, worths), axis=0)
        return at.y + scales[best][None] * descend

    def search_within(self, at: _Search, multiplier: Array, step: Array, near: Array) -> Array:
        """(N, A) as `search`, for ψ that end somewhere, where a step ends; who is near the solution only keeps inside."""

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
        """(A,) whether the first equation holds, and whether the second does, as far as float64 can tell."""
        pull, push, slope = here.pull, here.push, here.model.slope
        residual, gap = pull + push, here.model.level - here.sigma
        eps, tolerance = 8 * jnp.finfo(at.y.dtype).eps, self.precision.tolerance or 0.0
        rounding = eps * (jnp.abs(at.y) + jnp.abs(self.v))
        blur = self.kappa * rounding + here.multiplier[None] * here.model.bend.absolute(rounding)
        terms = jnp.sqrt(dot(pull, pull)) + jnp.sqrt(dot(push, push))
        settled = jnp.sqrt(dot(residual, residual)) <= tolerance * terms + jnp.sqrt(dot(blur, blur))
        return settled, jnp.abs(gap) <= tolerance + eps * jnp.abs(at.sigma) + dot(jnp.abs(slope), rounding)


def cold(lanes: Lanes, v: Array, kappa: Array) -> Guess:
    """Where to begin without a last solution: at v, with the multiplier that one step of Newton would want there, and with a soft minimum
    so blunt that it sees no kink between the constraints at v.

    Args:
        lanes: the objectives.
        v: (n, d, A).
        kappa: (n, A).
    """
    tiny = jnp.finfo(v.dtype).tiny
    sharpness = lanes.bluntest(lanes.violations(v))
    model = lanes.expand(v, sharpness)
    reach = add_up(model.slope**2 / jnp.repeat(kappa, v.shape[1], axis=0, total_repeat_length=len(model.slope)))
    height = model.level
    sigma = jnp.minimum(height, jnp.log1p(jnp.maximum(height, 0.0)) - jnp.log(jnp.maximum(reach, tiny)))
    if lanes.batch.partial:  # outside there is nothing to begin with
        sigma, sharpness = jnp.where(jnp.isfinite(sigma), sigma, 0.0), jnp.where(sharpness > 0.0, sharpness, 1.0)
    return Guess(v, sigma, sharpness)
