"""One round of the interior-point protocol for the agents of a batch. The last axis of every array is the agent (the lane), size A.

The variables of an agent are its n·d coordinates, then its level. Units are those of `lanes`.
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from consat.protocols.local.interior.algebra import gram, reduced, spread, times
from consat.protocols.local.interior.lanes import Here, Lanes, number
from consat.protocols.local.interior.prediction import observed, predicted
from consat.protocols.local.interior.proof import Proof, prove
from consat.protocols.local.interior.state import Gains, Memory, centered, mean
from consat.protocols.local.lanewise import solve

SHORTEST = 1e-9
"""Smallest step length of the line search; below it the step is not taken."""
TRUST = 0.5
"""Largest error of the model of a ψ after a step, as a fraction of its slack or of its predicted change, whichever is larger; for ψ that
are neither concave nor quadratic. The model is of first order, and of second order where ψ curves downwards."""
BACK, RAISE, EASE, HEAVIEST = 0.3, 2.0, 0.7, 10.0
"""Adaptive inertia. An agent that steps back by more than `BACK` of its last step multiplies its inertia by `RAISE`, else by `EASE`. The
result stays between 1 and `HEAVIEST` times the gain `inertia` of the protocol."""
STIFFEST = 1e12
"""As `HEAVIEST`, for an agent whose step was shortened because its model is poor. Its inertia becomes such that the full step would have
had that length (Levenberg, Marquardt). Its quadratics contain it too: neighbours must not rely on a model that holds only nearby."""
HOLD = 1e4
"""Factor on the inertia of an agent with ψ of that kind while it knows that the team is satisfied. It might not find back."""
GAP = 1e-2
"""Difference of levels, in units of ψ, below which a level is not lowered at once."""


class Mail(NamedTuple):
    """Message to each of g neighbours, or the last message from each. Inside a batch a last axis, the agent, follows.

    Attributes:
        matrix: (g, p, p) L of the quadratic ½ zᵀLz − eᵀz in the shared variables z. It summarises all that the sender knows from elsewhere.
        vector: (g, p) e.
        barrier: (g,) μ; negative where the message says nothing about the level.
        level: (g,) t.
        margin: (g,) smallest margin of all agents behind the sender.
        changes: (g,) the sender's `Memory.changes`.
        proof: see `Proof`.
    """

    matrix: Array
    vector: Array
    barrier: Array
    level: Array
    margin: Array
    changes: Array
    proof: Proof


class Point(NamedTuple):
    """Current point of the barrier problem; m includes the cap.

    Attributes:
        level: (A,) t.
        slack: (m, A) s = ψ − t; 1 where not used.
        multiplier: (m, A) λ.
        barrier: (A,) μ.
        used: (m, A) which constraints count.
        warm: (A,) whether the mean of the margins is maximised.
        inertia: (A,) κ, as a multiple of the gain `inertia`.
    """

    level: Array
    slack: Array
    multiplier: Array
    barrier: Array
    used: Array
    warm: Array
    inertia: Array


def act(lanes: Lanes, shared: Array, held: Array, memory: Memory, inbox: Mail, *, body_margin: Array, gains: Gains) -> tuple[Memory, Mail]:
    """Take one Newton step on the own constraints and the neighbours' quadratics; compute a quadratic and a proof for each neighbour.

    Args:
        lanes: the agents' constraints.
        shared: (g, p, A) indices of the variables shared with each neighbour.
        held: (n, A) false where copies are padded.
        memory: state before the step.
        inbox: the last message of each neighbour.
        body_margin: (A,) the agent's margin at the positions of the bodies.
        gains: gains of the protocol.

    Returns:
        The new state, and the mail to each neighbour.
    """
    n, d, _ = memory.y.shape
    changes = jnp.maximum(memory.changes, jnp.max(inbox.changes, axis=0, initial=0.0))
    best = jnp.where(changes > memory.changes, jnp.inf, memory.bound)
    proofs = inbox.proof._replace(weight=jnp.where(inbox.changes == changes[None], inbox.proof.weight, -1.0))
    theirs = spread(inbox.matrix, inbox.vector, shared, n * d + 1)
    lowest = jnp.min(jnp.where(inbox.barrier >= 0, inbox.level, jnp.inf), axis=0, initial=jnp.inf)

    began = memory._replace(y=predicted(lanes, memory))
    here = Here.of(lanes, began.y)
    known = jnp.minimum(body_margin, jnp.min(inbox.margin, axis=0, initial=jnp.inf))
    hold = jnp.where((known > 0) & lanes.bent.any(axis=0) & ~lanes.moves, HOLD, 1.0)
    point = lowered(lanes, here, memory._replace(inertia=hold * memory.inertia), lowest, gains)
    y, level, multiplier, swing, inertia = moved(lanes, here, began, point, theirs, gains)

    here = Here.of(lanes, y)
    point = renewed(lanes, here, point._replace(level=level, multiplier=multiplier, inertia=hold * inertia), inbox, gains)
    rest = jnp.maximum(memory.warm - 1.0, 0.0)
    point = point._replace(warm=rest > 0)
    proof, bound = prove(lanes, shared, held, y, here=here, multiplier=point.multiplier, inbox=proofs)
    speaks = (lanes.used[:-1].any(axis=0) | jnp.isfinite(lowest)) & ~point.warm
    left, e = summary(lanes, here, y, point, theirs, shared=shared, inbox=inbox, gains=gains)
    every = jnp.zeros(inbox.level.shape)
    mail = Mail(
        left,
        e,
        jnp.where(speaks[None], point.barrier[None], -1.0) + every,
        point.level[None] + every,
        _least_of_others(jnp.concatenate([body_margin[None], inbox.margin]))[1:],
        changes[None] + every,
        proof,
    )
    own, lid, bound = point.multiplier[:-1], point.multiplier[-1], jnp.minimum(best, bound)
    return Memory(
        y=y, multiplier=own, **observed(lanes, memory, y), lid=lid, level=point.level, barrier=point.barrier, bound=bound,
        age=memory.age + 1, inertia=inertia, swing=swing, warm=rest, changes=changes,
    ), mail  # fmt: skip


def lowered(lanes: Lanes, here: Here, memory: Memory, lowest: Array, gains: Gains) -> Point:
    """The point before the step: at the level of `memory`, or lower where a neighbour's level, `lowest`, (A,), is lower, or where
    constraints that move have brought the margin below the level."""
    some = lanes.used[:-1].any(axis=0)
    used = lanes.used & (here.psi > -jnp.inf)  # a ψ that is not finite has no usable slope
    multiplier = jnp.concatenate([memory.multiplier, memory.lid[None]])
    level, barrier = memory.level, memory.barrier
    margin = jnp.min(here.psi[:-1], axis=0, initial=jnp.inf, where=used[:-1])
    low = jnp.min(jnp.where(used, here.psi - level[None], jnp.inf), axis=0)
    lower = jnp.where(lowest < level - jnp.maximum(gains.drop * low, GAP), lowest, level)
    lower = jnp.where(margin <= lower, margin - jnp.maximum(GAP, 0.1 * jnp.abs(margin - lower)), lower)
    falls = some & (lower < level)
    level = jnp.where(falls, lower, jnp.where(some | ~jnp.isfinite(lowest), level, lowest))
    s = jnp.where(used, here.psi - level[None], 1.0)
    barrier = jnp.where(falls, jnp.maximum(barrier, gains.centering * mean(multiplier, s, used) / 3), barrier)
    multiplier = jnp.where(falls[None] & used, jnp.minimum(multiplier, barrier[None] / s), multiplier)
    return Point(level, s, multiplier, barrier, used, memory.warm > 0, memory.inertia)


def moved(
    lanes: Lanes, here: Here, memory: Memory, point: Point, theirs: tuple[Array, Array], gains: Gains
) -> tuple[Array, Array, Array, Array, Array]:
    """Take the Newton step. `theirs`: (N, N, A) matrix and (N, A) vector, the sum of the neighbours' quadratics.

    Returns:
        (n, d, A) copies, (A,) level, (m, A) multipliers, (A,) `Memory.swing`, and (A,) `Memory.inertia`.
    """
    y, (outside, pull) = memory.y, theirs
    n, d, count = y.shape
    level, s, multiplier, barrier, used, warm, _ = point
    matrix, gradient = model(lanes, here, point, gains.inertia, warm=gains.warm > 0)
    flat = jnp.concatenate([y.reshape(n * d, count), level[None]])
    step, _ = solve(matrix + outside, (pull - gradient - times(outside, flat))[:, None])
    step = jnp.where(jnp.isfinite(step).all(axis=(0, 1)), step[:, 0], 0.0)
    least = jnp.where(warm[None], -jnp.inf, (1.0 - gains.boundary) * s)
    scale, cut = length_of(lanes, here, point, flat, step, jnp.where(used, least, -jnp.inf))
    swing = jnp.sum(jnp.cos(2.4 * jnp.arange(1.0, n * d + 1))[:, None] * step[:-1], axis=0) * scale
    back = swing * memory.swing < -BACK * memory.swing**2
    inertia = jnp.clip(memory.inertia * jnp.where(back, RAISE, EASE), 1.0, HEAVIEST)
    if not lanes.convex:
        inertia = jnp.maximum(inertia, stiffened(memory.inertia, matrix + outside, step, cut, gains))
    flat = flat + scale[None] * step
    along = jnp.sum(here.slopes * step[None, :-1], axis=1) - step[-1][None]
    change = jnp.where(used, barrier[None] / s - multiplier - multiplier / s * along, 0.0)
    room = jnp.where(change < 0, gains.boundary * multiplier / jnp.where(change < 0, -change, 1.0), 1.0)
    multiplier = multiplier + jnp.minimum(1.0, jnp.min(room, axis=0))[None] * change
    return flat[:-1].reshape(y.shape), flat[-1], multiplier, swing, inertia


def stiffened(inertia: Array, matrix: Array, step: Array, cut: Array, gains: Gains) -> Array:
    """(A,) inertia with which the full step would have been shorter by the factor `cut`; `EASE` · `inertia` if that is more.

    Args:
        inertia: (A,) `Memory.inertia` before the step.
        matrix: (N, N, A) matrix of the step.
        step: (N, A) full step.
        cut: (A,) see `length_of`.
        gains: gains of the protocol.
    """
    square = jnp.sum(step[:-1] ** 2, axis=0)
    stiffness = jnp.sum(step * times(matrix, step), axis=0) / jnp.where(square > 0, square, 1.0)
    wanted = jnp.where(cut > 1.0, (cut - 1.0) * stiffness / gains.inertia, 0.0)
    return jnp.minimum(jnp.maximum(EASE * inertia, wanted), STIFFEST)


def renewed(lanes: Lanes, here: Here, point: Point, inbox: Mail, gains: Gains) -> Point:
    """The point after the step, with multipliers near the central path and a new barrier. While `point.warm`, all are those of the start
    from these copies; see `consat.protocols.local.interior.state.centered`."""
    some, said = lanes.used[:-1].any(axis=0), inbox.barrier >= 0
    fresh = centered(lanes, here.psi)
    level = jnp.where(point.warm, fresh[2], point.level)
    used = lanes.used & (here.psi > level[None])  # the slack is negative only where ψ became finite in this step
    margin = jnp.min(here.psi[:-1], axis=0, initial=jnp.inf)
    s = jnp.where(used, here.psi - level[None], 1.0)
    center = point.barrier[None] / s
    multiplier = jnp.where(used, jnp.clip(point.multiplier, center / 1e4, center * 1e4), 0.0)
    multiplier = jnp.where(point.warm[None], jnp.concatenate([fresh[0], fresh[1][None]]), multiplier)
    theirs = jnp.max(jnp.where(said, inbox.barrier, 0.0), axis=0, initial=0.0) / gains.couple
    apart = gains.apart * jnp.max(jnp.where(said, jnp.abs(inbox.level - level[None]), 0.0), axis=0, initial=0.0)
    size = jnp.maximum(1.0, jnp.minimum(jnp.abs(level), jnp.abs(margin)))
    wanted = jnp.maximum(gains.centering * mean(multiplier, s, used), gains.floor * size)
    barrier = jnp.where(some, jnp.maximum(wanted, jnp.maximum(theirs, apart)), theirs)
    return Point(level, s, multiplier, jnp.where(point.warm, fresh[3], barrier), used, point.warm, point.inertia)


def summary(
    lanes: Lanes, here: Here, y: Array, point: Point, theirs: tuple[Array, Array], *, shared: Array, inbox: Mail, gains: Gains
) -> tuple[Array, Array]:
    """(g, p, p, A) and (g, p, A) the quadratic for each neighbour: all that the agent knows except what this neighbour has sent, minimised
    over the variables not shared with it. 0 where it has no minimum."""
    size, (outside, pull) = y.shape[0] * y.shape[1] + 1, theirs
    matrix, gradient = model(lanes, here, point, gains.inertia, warm=gains.warm > 0)
    flat = jnp.concatenate([y.reshape(size - 1, -1), point.level[None]])
    left, e, _, fine = reduced(matrix + outside, times(matrix, flat) - gradient + pull, shared)
    left, e = left - inbox.matrix, e - inbox.vector
    if gains.warm:  # during warm-up messages contain nothing about the level
        places = ((shared < size - 1) | ~point.warm[None, None]).astype(float)
        left, e = left * places[:, :, None] * places[:, None], e * places
    fine &= jnp.isfinite(left).all(axis=(1, 2)) & jnp.isfinite(e).all(axis=1)
    return jnp.where(fine[:, None, None], left, 0.0), jnp.where(fine[:, None], e, 0.0)


def _least_of_others(numbers: Array) -> Array:
    """(k, A) → (k, A): for each entry the smallest of the other entries of its lane."""
    least, at = jnp.min(numbers, axis=0), jnp.argmin(numbers, axis=0)
    mine = jnp.arange(len(numbers), dtype=at.dtype)[:, None] == at[None]
    second = jnp.min(jnp.where(mine, jnp.inf, numbers), axis=0)
    return jnp.where(mine, second[None], least[None])


@functools.partial(jax.jit, static_argnames="warm")
def model(lanes: Lanes, here: Here, point: Point, stiffness: Array | float, *, warm: bool) -> tuple[Array, Array]:
    """(N, N, A) matrix M and (N, A) gradient g of the Newton step. Where `point.warm`, they are those of the mean of the margins, and the
    level is not a variable. `stiffness`: the gain `inertia`; `warm`: whether any agent may be warm."""
    _, s, multiplier, barrier, used, warms, inertia = point
    count = s.shape[-1]
    some = used[:-1].any(axis=0)
    which, (weights, vectors) = lanes.terms(), here.bends
    rows = jnp.concatenate([here.slopes, jnp.where(used, -1.0, 0.0)[:, None]], axis=1)
    pressed, stiff = jnp.where(used, barrier[None] / s, 0.0), jnp.where(used, multiplier / s, 0.0)
    if warm:
        share = jnp.where(used, 1.0 / jnp.maximum(number(used[:-1]), 1.0)[None], 0.0)
        share = jnp.concatenate([share[:-1], jnp.zeros((1, count))])
        pressed, stiff, multiplier = (jnp.where(warms[None], a, b) for a, b in ((share, pressed), (0.0, stiff), (share, multiplier)))
    bent = gram(weights * multiplier[which], vectors) if len(which) else jnp.zeros((rows.shape[1] - 1, rows.shape[1] - 1, count))
    matrix = gram(stiff, rows) + jnp.pad(bent, ((0, 1), (0, 1), (0, 0)))
    gradient = -jnp.sum(pressed[:, None] * rows, axis=0)
    gradient = gradient.at[-1].add(jnp.where(some, -1.0, 0.0))
    gradient = gradient.at[-1].set(jnp.where(warms, 0.0, gradient[-1]))
    trace = jnp.trace(matrix)  # independent of the padding, whose entries are 0
    still = jnp.where(warms, 1e-6, inertia * stiffness) + 1e-12 * trace
    own = jnp.where(warms, 1.0, 1e-9 * matrix[-1, -1] + jnp.where(some, 0.0, 1e-9))
    last = jnp.arange(len(matrix))[:, None] == len(matrix) - 1
    return matrix + jnp.eye(len(matrix))[:, :, None] * jnp.where(last, own[None], still[None])[:, None], gradient


def length_of(lanes: Lanes, here: Here, point: Point, flat: Array, step: Array, least: Array) -> tuple[Array, Array]:
    """Length of the step by backtracking.

    Args:
        lanes: the agents' constraints.
        here: ψ and its derivatives before the step.
        point: the point before the step.
        flat: (N, A) variables before the step.
        step: (N, A) full step.
        least: (m, A) lower bounds on the slacks.

    Returns:
        (A,) the length; 0 if none is found. After the step every slack is at least `least` and every used ψ is finite. The model of every
        ψ is as good as `TRUST` asks. An agent with ψ that are not concave goes no further than across the team's region, or than it is
        from the region's centre. (A,) the factor by which the last two conditions have shortened the step.
    """
    used, bent = point.used, lanes.bent & point.used
    way, away = (jnp.max(jnp.abs(each[:-1]), axis=0, initial=0.0) for each in (step, flat))
    most = jnp.where(lanes.concave, jnp.inf, lanes.units.reach + away)
    first, second = jnp.sum(here.slopes * step[None, :-1], axis=1), jnp.zeros(used.shape)
    which, (weights, vectors) = lanes.terms(), here.bends
    if len(which):
        second = second.at[which].add(weights * jnp.sum(vectors * step[None, :-1], axis=1) ** 2)

    def good(scale: Array) -> tuple[Array, Array]:
        new = flat + scale[None] * step
        psi = lanes.psi(new[:-1].reshape(lanes.shape))
        fine = jnp.all((psi - new[-1][None] >= least) & ((psi > -jnp.inf) | ~used), axis=0)
        if lanes.convex:
            return fine, fine
        error = jnp.abs(psi - (here.psi + scale[None] * first - 0.5 * scale[None] ** 2 * second))
        close = (error <= TRUST * jnp.maximum(point.slack, scale[None] * jnp.abs(first))) | ~bent
        return fine, fine & jnp.all(close, axis=0) & (scale * way <= most)

    def body(at: tuple[Array, Array, Array, Array]) -> tuple[Array, Array, Array, Array]:
        scale, bound, fine, close = at
        shorter = jnp.where(scale > SHORTEST, 0.7 * scale, 0.0)
        scale, bound = jnp.where(close, scale, shorter), jnp.where(fine, bound, shorter)
        now = good(scale)
        return scale, bound, fine | now[0] | (scale == 0.0), close | now[1] | (scale == 0.0)

    whole = jnp.ones(flat.shape[-1])
    scale, bound, *_ = jax.lax.while_loop(lambda at: jnp.any(~at[3]), body, (whole, whole, *good(whole)))
    return scale, jnp.where(bound > scale, bound / jnp.maximum(scale, SHORTEST), 1.0)
