"""One round of the interior-point protocol for the agents of a batch. The last axis of every array is the agent (the lane), size A.

Units: positions are relative to the centre of the team's region, in the team's unit of length; ψ is in the team's unit of ψ. So a team in
millimetres and the same team in kilometres take the same number of rounds. The variables of an agent are its n·d coordinates, then its
level. The last constraint of every agent is the cap: the level is at most `cap`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from consat.numerics import on_device
from consat.problem.units import Scale
from consat.protocols.local.interior.algebra import gram, reduced, solve, spread, times
from consat.protocols.local.interior.layout import Batch, Kind
from consat.protocols.local.lanewise import along, arguments

NUDGE = 1e-3
"""Copies start at this fraction of the way from the agent's own position to the initial estimate, so that no two copies coincide."""
WIDER = 0.5
"""`NUDGE` for agents with a ψ that is not quadratic. Near coinciding positions norms have a kink and inverse distances a pole, which the
steps leave slowly."""
TRIES = 24
"""Number of starting positions tried, at growing distance, while a ψ is not finite."""
SHORTEST = 1e-9
"""Smallest step length of the line search; below it the step is not taken."""
NEAR = 1e-3
"""Smallest initial slack, in units of ψ."""
BACK, RAISE, EASE, HEAVIEST = 0.3, 2.0, 0.7, 10.0
"""Adaptive inertia. An agent that steps back by more than `BACK` of its last step multiplies its inertia by `RAISE`, else by `EASE`. The
result stays between 1 and `HEAVIEST` times the gain `inertia` of the protocol."""
GAP = 1e-2
"""Difference of levels, in units of ψ, below which a level is not lowered at once."""


class Units(NamedTuple):
    """Units and region of the team; common knowledge. Scalars have shape ().

    Attributes:
        center: (d,) centre of the team's region, in the scenario's length.
        length: the team's unit of length.
        psi: the team's unit of ψ.
        reach: half width of the region on each axis, in units of `length`.
        extent: distance beyond the region to which constraints may lead, in units of `length`.
    """

    center: Array
    length: Array
    psi: Array
    reach: Array
    extent: Array

    @classmethod
    def of(cls, size: Scale) -> Units:
        """From the natural scale of a team."""
        return cls(
            on_device(size.center),
            on_device(size.length),
            on_device(size.typical),
            on_device(size.reach / size.length),
            on_device(size.extent / size.length),
        )


class Memory(NamedTuple):
    """State of the interior-point step. Shapes are for one agent; inside a batch the last axis is the agent.

    Attributes:
        y: (n, d) copies.
        multiplier: (m,) λ_ik; 0 where padded.
        lid: λ of the cap.
        level: t_i.
        barrier: μ_i.
        bound: smallest proven bound on the best margin so far.
        age: rounds since the start.
        inertia: κ_i, as a multiple of the gain `inertia`.
        swing: component of the last step along a fixed direction, to detect oscillation.
        warm: remaining rounds in which the mean of the margins is maximised.
        changes: largest known number of constraint changes, own or received. A proof is valid only for constraints with the same number.
    """

    y: Array
    multiplier: Array
    lid: Array
    level: Array
    barrier: Array
    bound: Array
    age: Array
    inertia: Array
    swing: Array
    warm: Array
    changes: Array


class Proof(NamedTuple):
    """Upper bound c + eᵀz − ½ zᵀLz on Σ λψ over all agents behind the sender, maximised over the variables not shared with the receiver.

    Attributes:
        matrix: (g, p, p) L; 0 for the level.
        vector: (g, p) e.
        constant: (g,) c.
        weight: (g,) Σ λ; negative where there is no proof.
        error: (g,) bound on the rounding error of c.
    """

    matrix: Array
    vector: Array
    constant: Array
    weight: Array
    error: Array


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


@dataclass(frozen=True)
class Gains:
    """Gains of the step; see `consat.protocols.interior_point.InteriorPoint`."""

    cap: float | None
    inertia: float
    centering: float
    boundary: float
    floor: float
    couple: float
    apart: float
    drop: float
    warm: int
    far: float


@dataclass(frozen=True)
class Lanes:
    """The constraints of the agents of one chunk; m below includes the cap.

    Attributes:
        batch: static properties of the agents; its arrays are not used.
        kinds: the constraints, without the axis of chunks.
        units: see `Units`.
        cap: upper bound on the level, in units of ψ; None without a cap.
        shape: (n, d, A).
        exact: whether bounds can be proven; see `Plan.exact`.
    """

    batch: Batch
    kinds: tuple[Kind, ...]
    units: Units
    cap: float | None
    shape: tuple[int, int, int]
    exact: bool

    @property
    def quadratic(self) -> Array:
        """(A,) whether all ψ of an agent are quadratic."""
        others = [kind.used.any(axis=0) for form, kind in self._each() if not form.quadratic]
        return ~jnp.any(jnp.stack([jnp.zeros(self.shape[2], bool), *others]), axis=0)

    @property
    def used(self) -> Array:
        """(m, A) false where padded."""
        own = jnp.concatenate([jnp.zeros((0, self.shape[2]), bool), *(kind.used for kind in self.kinds)])
        return jnp.concatenate([own, own.any(axis=0, keepdims=True) & (self.cap is not None)])

    def psi(self, y: Array) -> Array:
        """(m, A) ψ at the copies `y`, (n, d, A), the cap last; −∞ outside the domain of ψ, +∞ where padded."""
        own = [self._masked(kind, along(_at(form.psi))(self._arguments(kind, y), kind.parameters)) for form, kind in self._each()]
        return self._with_cap(own)

    def slopes(self, y: Array) -> tuple[Array, Array]:
        """(m, A) ψ and (m, n·d, A) ∇ψ at the copies `y`, (n, d, A); entries of ∇ψ that are not finite are 0."""
        values, gradients = [], []
        for form, kind in self._each():
            value, found = along(jax.value_and_grad(_at(form.psi)))(self._arguments(kind, y), kind.parameters)
            slope = found * (kind.weight * self.units.length / self.units.psi)[:, None, None]
            values.append(self._masked(kind, value))
            gradients.append(self._placed(kind, jnp.where(jnp.isfinite(slope) & kind.used[:, None, None], slope, 0.0)))
        n, d, count = self.shape
        return self._with_cap(values), jnp.concatenate([*gradients, jnp.zeros((1, n * d, count))])

    def bends(self, y: Array, quadratic: bool = False) -> tuple[Array, Array, Array]:
        """Curvature of the constraints as r rank-one terms: Σ w λ v vᵀ is the convex part of −Σ_k λ_k ∇²ψ_k.

        Args:
            y: (n, d, A) copies.
            quadratic: whether to include only quadratic ψ, whose curvature is the same everywhere.

        Returns:
            (r,) the constraint of each term, (r, A) weights w, and (r, n·d, A) vectors v.
        """
        n, d, count = self.shape
        which, weights, vectors, done = [], [jnp.zeros((0, count))], [jnp.zeros((0, n * d, count))], 0
        for form, kind in self._each():
            m, arity, _ = kind.slots.shape
            scale = jnp.where(kind.used, kind.weight * self.units.length**2 / self.units.psi, 0.0)
            if form.curvature is not None:
                rank = len(form.curvature)
                values = jnp.ones((m, rank, count))
                found = jnp.broadcast_to(jnp.asarray(form.curvature).reshape(rank, arity, d, 1), (m, rank, arity, d, count))
            elif quadratic and not form.quadratic:
                rank, values, found = 0, jnp.zeros((m, 0, count)), jnp.zeros((m, 0, arity, d, count))
            else:
                rank = arity * d
                values, found = along(_bend(form.psi, arity, d))(self._arguments(kind, y), kind.parameters)
            if rank:
                rows = jnp.repeat(kind.slots, rank, axis=0, total_repeat_length=m * rank)
                which += [done + k for k in range(m) for _ in range(rank)]
                weights.append((scale[:, None] * values).reshape(m * rank, count))
                vectors.append(self._placed(kind._replace(slots=rows), found.reshape(m * rank, arity, d, count)))
            done += m
        return jnp.asarray(which, dtype=int), jnp.concatenate(weights), jnp.concatenate(vectors)

    def _each(self) -> Any:
        return zip(self.batch.forms, self.kinds, strict=True)

    def _with_cap(self, own: list[Array]) -> Array:
        return jnp.concatenate([*own, jnp.full((1, self.shape[2]), jnp.inf if self.cap is None else self.cap)])

    def _masked(self, kind: Kind, value: Array) -> Array:
        value = jnp.where(jnp.isfinite(value), kind.weight * value / self.units.psi, -jnp.inf)
        return jnp.where(kind.used, value, jnp.inf)

    def _arguments(self, kind: Kind, y: Array) -> Array:
        """(m, arity, d, A) the arguments of each ψ, in the scenario's units."""
        return arguments(self.units.center[None, :, None] + self.units.length * y, kind.slots)

    def _placed(self, kind: Kind, slope: Array) -> Array:
        """(m, arity, d, A) → (m, n·d, A): from the arguments of each constraint to the agent's coordinates."""
        n, d, count = self.shape
        where = jnp.arange(n, dtype=jnp.int32)[None, None, :, None] == kind.slots[:, :, None]  # (m, arity, n, A)
        return jnp.sum(jnp.where(where[:, :, :, None], slope[:, :, None], 0.0), axis=1).reshape(len(slope), n * d, count)


def _at(psi: Any) -> Any:
    """ψ as a function of an array of positions, (arity, d), and a dictionary of parameters."""
    return lambda x, p: psi(*x, **p)


def _bend(psi: Any, arity: int, d: int) -> Any:
    """Function of positions, (arity, d), and parameters that returns the eigenvalues of −∇²ψ, clipped at 0, (R,), and the eigenvectors,
    (R, arity, d)."""

    def one(x: Array, p: dict[str, Array]) -> tuple[Array, Array]:
        hessian = -jax.hessian(_at(psi))(x, p).reshape(arity * d, arity * d)
        values, vectors = jnp.linalg.eigh(jnp.where(jnp.isfinite(hessian).all(), 0.5 * (hessian + hessian.T), 0.0))
        return jnp.maximum(values, 0.0), vectors.T.reshape(arity * d, arity, d)

    return one


class Here(NamedTuple):
    """Values and derivatives of the constraints at the copies.

    Attributes:
        psi: (m, A) ψ.
        slopes: (m, n·d, A) ∇ψ.
        bends: see `Lanes.bends`.
    """

    psi: Array
    slopes: Array
    bends: tuple[Array, Array, Array]

    @classmethod
    def of(cls, lanes: Lanes, y: Array) -> Here:
        return cls(*lanes.slopes(y), lanes.bends(y))


def begin(lanes: Lanes, y: Array, gains: Gains) -> Memory:
    """Initial state: every copy near the agent's own position, and the level below its margin there.

    Args:
        lanes: the agents' constraints.
        y: (n, d, A) initial estimates, the own position first.
        gains: gains of the protocol.
    """
    y = placed(lanes, y)
    psi = lanes.psi(y)
    number = jnp.zeros(y.shape[-1])
    violated = (jnp.min(psi[:-1], axis=0, initial=jnp.inf) < -gains.far) & lanes.quadratic
    return Memory(
        y, *centered(lanes, psi), number + jnp.inf, number, number + 1.0, number, jnp.where(violated, float(gains.warm), 0.0), number
    )


def placed(lanes: Lanes, y: Array) -> Array:
    """(n, d, A) initial copies: near the agent's own position. Where a ψ is not finite there, the initial estimates `y` are used. Where a ψ
    is not finite at these either, the nearest of `TRIES` pseudo-random points around them at which all ψ are finite is used."""
    near = y[:1] + jnp.where(lanes.quadratic, NUDGE, WIDER)[None, None] * (y - y[:1])

    def wrong(y: Array) -> Array:
        return jnp.any(lanes.used & (lanes.psi(y) == -jnp.inf), axis=0)

    def body(at: tuple[Array, Array]) -> tuple[Array, Array]:
        k, now = at
        phase = jnp.arange(1.0, now[..., 0].size + 1).reshape(now.shape[:2])[:, :, None]
        away = jnp.sin(1e3 * (k + 1.0) * phase + 1e2 * y) * lanes.units.reach * 2.0 ** (0.25 * (k - 20.0))
        return k + 1.0, jnp.where(wrong(now), jnp.where(k == 0.0, y, y + away), now)

    def more(at: tuple[Array, Array]) -> Array:
        return (at[0] <= float(TRIES)) & jnp.any(wrong(at[1]))

    return jax.lax.while_loop(more, body, (jnp.zeros(()), near))[1]


def centered(lanes: Lanes, psi: Array) -> tuple[Array, Array, Array, Array]:
    """Multipliers, level and barrier on the central path, for a level well below the margin. `psi`: (m, A).

    Returns:
        (m − 1, A) λ, (A,) λ of the cap, (A,) level, and (A,) barrier.
    """
    used = lanes.used & (psi > -jnp.inf)
    margin = jnp.min(jnp.where(used, psi, jnp.inf)[:-1], axis=0, initial=jnp.inf)
    some = jnp.isfinite(margin)
    level = jnp.where(some, margin - jnp.maximum(NEAR, jnp.abs(margin)), 0.0)
    if lanes.cap is not None:
        level = jnp.minimum(level, lanes.cap - NEAR)
    s = jnp.where(used, psi - level[None], 1.0)
    inverse = jnp.where(used, 1.0 / s, 0.0)
    multiplier = inverse / jnp.maximum(jnp.sum(inverse, axis=0), jnp.finfo(s.dtype).tiny)[None]
    return multiplier[:-1], multiplier[-1], level, mean(multiplier, s, used)


def mean(multiplier: Array, s: Array, used: Array) -> Array:
    """(A,) mean of λ s over the used constraints of each agent; all arguments have shape (m, A)."""
    return jnp.sum(jnp.where(used, multiplier * s, 0.0), axis=0) / jnp.maximum(number(used), 1.0)


def number(mask: Array) -> Array:
    """(k, A) → (A,) number of true entries."""
    return jnp.sum(mask.astype(float), axis=0)


def act(lanes: Lanes, shared: Array, held: Array, memory: Memory, inbox: Mail, *, told: Array, gains: Gains) -> tuple[Memory, Mail]:
    """Take one Newton step on the own constraints and the neighbours' quadratics; compute a quadratic and a proof for each neighbour.

    Args:
        lanes: the agents' constraints.
        shared: (g, p, A) indices of the variables shared with each neighbour.
        held: (n, A) false where copies are padded.
        memory: state before the step.
        inbox: the last message of each neighbour.
        told: (A,) the agent's margin at the positions of the bodies.
        gains: gains of the protocol.

    Returns:
        The new state, and the mail to each neighbour.
    """
    n, d, count = memory.y.shape
    size = n * d + 1
    changes = jnp.maximum(memory.changes, jnp.max(inbox.changes, axis=0, initial=0.0))
    best = jnp.where(changes > memory.changes, jnp.inf, memory.bound)
    proofs = inbox.proof._replace(weight=jnp.where(inbox.changes == changes[None], inbox.proof.weight, -1.0))
    some = lanes.used[:-1].any(axis=0)
    outside, pull = spread(inbox.matrix, inbox.vector, shared, size)
    said = inbox.barrier >= 0
    lowest = jnp.min(jnp.where(said, inbox.level, jnp.inf), axis=0, initial=jnp.inf)
    y, level, barrier = memory.y, memory.level, memory.barrier
    multiplier = jnp.concatenate([memory.multiplier, memory.lid[None]])
    warm = memory.warm > 0

    # lower the level to the lowest level received, or below the margin where constraints have moved
    here = Here.of(lanes, y)
    used = lanes.used & (here.psi > -jnp.inf)  # a ψ that is not finite has no usable slope
    margin = jnp.min(here.psi[:-1], axis=0, initial=jnp.inf, where=used[:-1])
    low = jnp.min(jnp.where(used, here.psi - level[None], jnp.inf), axis=0)
    lower = jnp.where(lowest < level - jnp.maximum(gains.drop * low, GAP), lowest, level)
    lower = jnp.where(margin <= lower, margin - jnp.maximum(GAP, 0.1 * jnp.abs(margin - lower)), lower)
    moved = some & (lower < level)
    level = jnp.where(moved, lower, jnp.where(some | ~jnp.isfinite(lowest), level, lowest))
    s = jnp.where(used, here.psi - level[None], 1.0)
    barrier = jnp.where(moved, jnp.maximum(barrier, gains.centering * mean(multiplier, s, used) / 3), barrier)
    multiplier = jnp.where(moved[None] & used, jnp.minimum(multiplier, barrier[None] / s), multiplier)

    # Newton step
    matrix, gradient = model(here, Point(s, multiplier, barrier, used, warm, memory.inertia * gains.inertia), gains)
    flat = jnp.concatenate([y.reshape(n * d, count), level[None]])
    step, _ = solve(matrix + outside, (pull - gradient - times(outside, flat))[:, None])
    step = jnp.where(jnp.isfinite(step).all(axis=(0, 1)), step[:, 0], 0.0)
    least = jnp.where(warm[None], -jnp.inf, (1.0 - gains.boundary) * s)
    scale = longest(lanes, flat, step, jnp.where(used, least, -jnp.inf), used)
    swing = jnp.sum(jnp.cos(2.4 * jnp.arange(1.0, n * d + 1))[:, None] * step[:-1], axis=0) * scale
    back = swing * memory.swing < -BACK * memory.swing**2
    inertia = jnp.clip(memory.inertia * jnp.where(back, RAISE, EASE), 1.0, HEAVIEST)
    flat = flat + scale[None] * step
    y, level = flat[:-1].reshape(y.shape), flat[-1]
    along = jnp.sum(here.slopes * step[None, :-1], axis=1) - step[-1][None]
    change = jnp.where(used, barrier[None] / s - multiplier - multiplier / s * along, 0.0)
    room = jnp.where(change < 0, gains.boundary * multiplier / jnp.where(change < 0, -change, 1.0), 1.0)
    multiplier = multiplier + jnp.minimum(1.0, jnp.min(room, axis=0))[None] * change

    # constraints, multipliers and barrier after the step
    here = Here.of(lanes, y)
    fresh = centered(lanes, here.psi)
    level = jnp.where(warm, fresh[2], level)
    used = lanes.used & (here.psi > level[None])  # the slack is negative only where ψ became finite in this step
    margin = jnp.min(here.psi[:-1], axis=0, initial=jnp.inf)
    s = jnp.where(used, here.psi - level[None], 1.0)
    center = barrier[None] / s
    multiplier = jnp.where(used, jnp.clip(multiplier, center / 1e4, center * 1e4), 0.0)
    multiplier = jnp.where(warm[None], jnp.concatenate([fresh[0], fresh[1][None]]), multiplier)
    theirs = jnp.max(jnp.where(said, inbox.barrier, 0.0), axis=0, initial=0.0) / gains.couple
    apart = gains.apart * jnp.max(jnp.where(said, jnp.abs(inbox.level - level[None]), 0.0), axis=0, initial=0.0)
    size_of = jnp.maximum(1.0, jnp.minimum(jnp.abs(level), jnp.abs(margin)))
    wanted = jnp.maximum(gains.centering * mean(multiplier, s, used), gains.floor * size_of)
    barrier = jnp.where(some, jnp.maximum(wanted, jnp.maximum(theirs, apart)), theirs)
    barrier = jnp.where(warm, fresh[3], barrier)

    # messages
    rest = jnp.maximum(memory.warm - 1.0, 0.0)
    warm = rest > 0
    matrix, gradient = model(here, Point(s, multiplier, barrier, used, warm, inertia * gains.inertia), gains)
    flat = jnp.concatenate([y.reshape(n * d, count), level[None]])
    left, e, _, fine = reduced(matrix + outside, times(matrix, flat) - gradient + pull, shared)
    left, e = left - inbox.matrix, e - inbox.vector
    if gains.warm:  # during warm-up messages contain nothing about the level
        places = ((shared < size - 1) | ~warm[None, None]).astype(float)
        left, e = left * places[:, :, None] * places[:, None], e * places
    fine &= jnp.isfinite(left).all(axis=(1, 2)) & jnp.isfinite(e).all(axis=1)
    speaks = (some | jnp.isfinite(lowest)) & ~warm
    proof, bound = prove(lanes, shared, held, y, here=here, multiplier=multiplier, inbox=proofs)
    behind = _least_of_others(jnp.concatenate([told[None], inbox.margin]))[1:]
    mail = Mail(
        jnp.where(fine[:, None, None], left, 0.0),
        jnp.where(fine[:, None], e, 0.0),
        jnp.where(speaks[None], barrier[None], -1.0) + jnp.zeros(fine.shape),
        level[None] + jnp.zeros(fine.shape),
        behind,
        changes[None] + jnp.zeros(fine.shape),
        proof,
    )
    after = Memory(
        y, multiplier[:-1], multiplier[-1], level, barrier, jnp.minimum(best, bound), memory.age + 1, inertia, swing, rest, changes
    )
    return after, mail


def _least_of_others(numbers: Array) -> Array:
    """(k, A) → (k, A): for each entry the smallest of the other entries of its lane."""
    least, at = jnp.min(numbers, axis=0), jnp.argmin(numbers, axis=0)
    mine = jnp.arange(len(numbers), dtype=at.dtype)[:, None] == at[None]
    second = jnp.min(jnp.where(mine, jnp.inf, numbers), axis=0)
    return jnp.where(mine, second[None], least[None])


class Point(NamedTuple):
    """Current point of the barrier problem; m includes the cap.

    Attributes:
        slack: (m, A) s = ψ − t.
        multiplier: (m, A) λ.
        barrier: (A,) μ.
        used: (m, A) which constraints count.
        warm: (A,) whether the mean of the margins is maximised.
        inertia: (A,) κ.
    """

    slack: Array
    multiplier: Array
    barrier: Array
    used: Array
    warm: Array
    inertia: Array


def model(here: Here, point: Point, gains: Gains) -> tuple[Array, Array]:
    """(N, N, A) matrix M and (N, A) gradient g of the Newton step. Where `point.warm`, they are those of the mean of the margins, and the
    level is not a variable."""
    s, multiplier, barrier, used, warm, inertia = point
    count = s.shape[-1]
    some = used[:-1].any(axis=0)
    which, weights, vectors = here.bends
    rows = jnp.concatenate([here.slopes, jnp.where(used, -1.0, 0.0)[:, None]], axis=1)
    pressed, stiff = jnp.where(used, barrier[None] / s, 0.0), jnp.where(used, multiplier / s, 0.0)
    if gains.warm:
        share = jnp.where(used, 1.0 / jnp.maximum(number(used[:-1]), 1.0)[None], 0.0)
        share = jnp.concatenate([share[:-1], jnp.zeros((1, count))])
        pressed, stiff, multiplier = (jnp.where(warm[None], a, b) for a, b in ((share, pressed), (0.0, stiff), (share, multiplier)))
    bent = gram(weights * multiplier[which], vectors) if len(which) else jnp.zeros((rows.shape[1] - 1, rows.shape[1] - 1, count))
    matrix = gram(stiff, rows) + jnp.pad(bent, ((0, 1), (0, 1), (0, 0)))
    gradient = -jnp.sum(pressed[:, None] * rows, axis=0)
    gradient = gradient.at[-1].add(jnp.where(some, -1.0, 0.0))
    gradient = gradient.at[-1].set(jnp.where(warm, 0.0, gradient[-1]))
    trace = jnp.trace(matrix)  # independent of the padding, whose entries are 0
    still = jnp.where(warm, 1e-6, inertia) + 1e-12 * trace
    own = jnp.where(warm, 1.0, 1e-9 * matrix[-1, -1] + jnp.where(some, 0.0, 1e-9))
    last = jnp.arange(len(matrix))[:, None] == len(matrix) - 1
    return matrix + jnp.eye(len(matrix))[:, :, None] * jnp.where(last, own[None], still[None])[:, None], gradient


def longest(lanes: Lanes, flat: Array, step: Array, least: Array, used: Array) -> Array:
    """(A,) step length by backtracking: after the step every slack is at least `least` and every used ψ is finite; 0 if none is found.

    Args:
        lanes: the agents' constraints.
        flat: (N, A) variables before the step.
        step: (N, A) full step.
        least: (m, A) lower bounds on the slacks.
        used: (m, A) which constraints count.
    """

    def good(scale: Array) -> Array:
        new = flat + scale[None] * step
        psi = lanes.psi(new[:-1].reshape(lanes.shape))
        return jnp.all((psi - new[-1][None] >= least) & ((psi > -jnp.inf) | ~used), axis=0)

    def body(at: tuple[Array, Array]) -> tuple[Array, Array]:
        scale, done = at
        scale = jnp.where(done, scale, jnp.where(scale > SHORTEST, 0.7 * scale, 0.0))
        return scale, good(scale) | (scale == 0.0)

    whole = jnp.ones(flat.shape[-1])
    return jax.lax.while_loop(lambda at: jnp.any(~at[1]), body, (whole, good(whole)))[0]


REGION = 10.0
"""Radius R of the region for which a proof holds, in multiples of the team's reach around its centre; `Units.extent` is added to it."""
SLACK = 3e-4
"""Largest increase of the bound by the restriction to that region, in units of ψ; a little more where agents without constraints relay."""
IDLE = 0.01
"""Weight that replaces Σ λ = 0 of an agent without constraints in that restriction."""


def prove(lanes: Lanes, shared: Array, held: Array, y: Array, *, here: Here, multiplier: Array, inbox: Proof) -> tuple[Proof, Array]:
    """The proof for each neighbour, and (A,) an upper bound on the best margin: max_x Σ λψ / Σ λ over all agents (design, section 9).

    A ψ that is not quadratic is replaced by its tangent, which is an upper bound on a concave ψ. To make every direction strictly concave,
    each agent adds ε w (R² − ‖x_i‖²) with w = Σ λ, or w = `IDLE` without constraints. This term is not negative within radius R of the
    team's centre, so that the bound holds for all formations in that region.

    Rounding is outward. Sums and eliminations of positive definite systems are backward stable: the computed result is exact for a matrix,
    a vector and a constant whose entries differ by at most `eps` times the terms summed in them (Higham, Accuracy and Stability of
    Numerical Algorithms, sections 10.1 and 14.4). This changes a quadratic at z by at most eps (|c| + |e|ᵀ|z| + ½ |z|ᵀ|L||z|). Every agent
    adds this error for its own terms and for every quadratic that it solves or forwards, with |z| at its estimates and at the maximiser;
    farther away the quadratic has decreased by more than the error. The error of ψ and ∇ψ is that of rounding a position, whose absolute
    value includes the team's centre. In addition, formations within R/2 have a reserve of at least ¾ `SLACK`.

    Args:
        lanes: the agents' constraints.
        shared: (g, p, A) indices of the variables shared with each neighbour.
        held: (n, A) false where copies are padded.
        y: (n, d, A) copies.
        here: constraints at `y`.
        multiplier: (m, A) λ, the cap last.
        inbox: the last proof of each neighbour.
    """
    n, d, count = y.shape
    size, (g, p, _) = n * d, shared.shape
    if not lanes.exact or not all(form.concave for form in lanes.batch.forms):
        zero = jnp.zeros((g, count))
        return Proof(jnp.zeros((g, p, p, count)), jnp.zeros((g, p, count)), zero, zero - 1.0, zero), jnp.full(count, jnp.inf)
    used, flat = lanes.used[:-1] & (here.psi[:-1] > -jnp.inf), y.reshape(size, count)
    psi, slopes, multiplier = jnp.where(used, here.psi[:-1], 0.0), here.slopes[:-1], jnp.where(used, multiplier[:-1], 0.0)
    which, weights, vectors = lanes.bends(y, quadratic=True)
    matrix = gram(weights * multiplier[which], vectors) if len(which) else jnp.zeros((size, size, count))
    weight, value, slope = jnp.sum(multiplier, axis=0), jnp.sum(multiplier * psi, axis=0), jnp.sum(multiplier[:, None] * slopes, axis=0)
    bent = times(matrix, flat)
    vector, constant = slope + bent, value - jnp.sum(slope * flat + 0.5 * flat * bent, axis=0)
    eps = 8.0 * size * jnp.finfo(y.dtype).eps
    steep, far = jnp.abs(slope), jnp.abs(flat) + jnp.tile(lanes.units.reach + jnp.abs(lanes.units.center) / lanes.units.length, n)[:, None]
    sizes = jnp.abs(multiplier * psi).sum(axis=0) + jnp.sum((steep + times(jnp.abs(matrix), jnp.abs(flat))) * far, axis=0)
    reach = REGION * lanes.units.reach + lanes.units.extent
    curve = SLACK / reach**2 * jnp.where(used.any(axis=0), weight, IDLE)
    own = (jnp.arange(size) < d)[:, None]
    absent = jnp.repeat(~held, d, axis=0, total_repeat_length=size)
    matrix = matrix + jnp.eye(size)[:, :, None] * (jnp.where(own, 2 * curve[None], 0.0) + absent.astype(float))[:, None]

    places = jnp.where(shared < size, shared, size)  # the level is not a variable of the proof
    outside, pull = spread(inbox.matrix, inbox.vector, places, size)
    neighbour, have = (shared <= size).any(axis=1), inbox.weight >= 0
    missing = number(neighbour & ~have)
    total, forces = matrix + outside, vector + pull
    height = constant + curve * reach**2 + jnp.sum(inbox.constant, axis=0)
    error = eps * sizes + jnp.sum(inbox.error, axis=0)
    mass = weight + jnp.sum(jnp.where(have, inbox.weight, 0.0), axis=0)
    found, fine = solve(total, forces[:, None])
    gain = 0.5 * jnp.sum(forces * found[:, 0], axis=0)
    away = jnp.abs(flat) + jnp.where(fine, jnp.abs(found[:, 0]), 0.0)
    error += eps * (jnp.abs(height) + jnp.sum(away * (jnp.abs(forces) + 0.5 * times(jnp.abs(total), away)), axis=0))
    bound = (height + gain + error) / jnp.where(mass > 0, mass, 1.0)
    bound = jnp.where(fine & (missing == 0) & (mass > 0) & jnp.isfinite(bound), bound, jnp.inf)

    left, e, gain, fine = reduced(total, forces, places)
    left, e, constant = left - inbox.matrix, e - inbox.vector, height[None] - inbox.constant + gain
    error = error[None] - inbox.error + eps * (jnp.abs(constant) + jnp.abs(gain))
    complete = missing[None] == (neighbour & ~have).astype(float)
    good = fine & complete & neighbour & jnp.isfinite(left).all(axis=(1, 2)) & jnp.isfinite(e).all(axis=1) & jnp.isfinite(constant)
    return Proof(
        jnp.where(good[:, None, None], left, 0.0),
        jnp.where(good[:, None], e, 0.0),
        jnp.where(good, constant, 0.0),
        jnp.where(good, mass[None] - jnp.where(have, inbox.weight, 0.0), -1.0),
        jnp.where(good, error, 0.0),
    ), bound
