"""What else finds the least violating formation, in NumPy: exact Newton steps, gradient methods, subgradients and dual decomposition.

All solve max t subject to ψ_ik(x) ≥ t, or climb the smooth margin in its place, for a team of concave quadratics. A lane is one choice of
parameters; all lanes of a method run at once. Every method answers with the team's margin, at the agents' own positions, after each round.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import peers
from scipy.sparse import coo_array, csr_array

import consat as cs
from consat.certify.quadratics import expand
from consat.problem.objective import STEEPEST, Nu
from consat.protocols.estimates import Estimates

Floats = np.ndarray
Rounds = Iterator[Floats]
"""(L,) the margin of every lane, round after round, the start first."""

NEAR = 0.5
"""Half the side of the box around the best formation from which methods on the smooth objective may start too."""
NU = (1.0, 0.2, 0.04)
"""Of what `consat` smooths with: a softer objective stops farther from the best margin, and overflows less."""
FLOW_STEPS = np.geomspace(2e-3, 0.5, 9)
EXTRA_STEPS = np.geomspace(1e-6, 1.0, 9)
"""In units of 1/f at the best margin: smaller by e^{ν |β̄*|} for ∇f itself."""
SUBGRADIENT_STEPS = np.geomspace(0.01, 30.0, 9)
SUBGRADIENT_DECAY = (0.0, 0.5, 1.0)
"""The step in round k is h k^−p."""
PASSES = 3
"""Of each agent over its own constraints in a round, to get back to where all of them hold."""
DUAL_WEIGHTS = np.geomspace(0.03, 10.0, 7)
"""ρ N, of the proximal term: what an agent gains from a higher level is 1/N."""
DUAL_PART = 0.95
"""γ, as a part of what is known to converge: ρ/2‖A‖², where 2 × the largest degree stands for ‖A‖²."""
FIRST_STEPS, LOCAL_STEPS = 20, 4
"""Newton steps of each agent on its own problem, in the first round and in the others, which go on from where the last ended."""
SWEEP_GAINS = tuple(itertools.product((0.5, 0.3, 0.1), (0.7, 0.9, 0.99)))
"""σ, and the part of any slack or multiplier that a step may take."""
SWEEP_STEPS = 60
SWEEP_FLOOR = 1e-8
"""Of the barrier, relative to the level: below that nothing is gained, and digits are lost."""
SWEEP_INERTIA = 1e-9
"""κ: of an agent that nothing binds, the step is not defined without."""


@dataclass(frozen=True)
class Arrays:
    """A team of concave quadratics ψ_k = c_k + b_k·y + ½ yᵀH_k y, its constraints ordered by owner, their coordinates padded to n.

    Attributes:
        copies: local estimates.
        links: (E, 2) of the team.
        owner: (M,).
        value: (M,) c.
        gradient: (M, n) b.
        hessian: (M, n, n) H.
        at_positions: (M, n) coordinates among the N·d positions; padded with N·d.
        at_copies: (M, n) coordinates among the C·d copies; padded with C·d.
        dimension: d.
    """

    copies: Estimates
    links: np.ndarray
    owner: np.ndarray
    value: Floats
    gradient: Floats
    hessian: Floats
    at_positions: np.ndarray
    at_copies: np.ndarray
    dimension: int

    @classmethod
    def of(cls, team: cs.Team) -> Arrays:
        d, copies = team.dimension, Estimates.of(team, "local")
        model = expand(team, np.zeros((team.count, d)))
        count, width = len(team.owner), max(block.columns.shape[1] for block in model.blocks)
        gradient, hessian = np.zeros((count, width)), np.zeros((count, width, width))
        here = np.full((count, width), team.count * d)
        held = np.full((count, width), copies.count * d)
        for block in model.blocks:
            n = block.columns.shape[1]
            gradient[block.number, :n] = block.gradient
            hessian[block.number, :n, :n] = block.hessian
            here[block.number, :n] = block.columns
            rows = copies.rows(team.owner[block.number][:, None], block.columns // d)
            held[block.number, :n] = rows * d + block.columns % d
        order = np.argsort(team.owner, kind="stable")
        parts = (team.owner, model.value, gradient, hessian, here, held)
        return cls(copies, team.links, *(part[order] for part in parts), d)

    @property
    def count(self) -> int:
        """N."""
        return len(self.copies.own)

    @functools.cached_property
    def groups(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(G,) agents that have constraints, (G,) where theirs begin, and (M,) the group of each constraint."""
        agents, starts, group = np.unique(self.owner, return_index=True, return_inverse=True)
        return agents, starts, group

    def psi(self, y: Floats, at: np.ndarray) -> tuple[Floats, Floats]:
        """(M, L) values and (M, n, L) gradients at (rows·d, L) positions or copies."""
        local = np.concatenate([y, np.zeros((1, y.shape[1]))])[at]
        bent = np.matmul(self.hessian, local)
        slope = self.gradient[..., None] + bent
        return self.value[:, None] + np.sum((slope - 0.5 * bent) * local, axis=1), slope

    def margin(self, y: Floats) -> Floats:
        """(L,) β̄ at the agents' own positions among (C·d, L) copies; −∞ where they are no numbers."""
        own = y.reshape(-1, self.dimension, y.shape[1])[self.copies.own].reshape(-1, y.shape[1])
        least = self.psi(own, self.at_positions)[0].min(axis=0)
        return np.where(np.isfinite(own).all(axis=0) & np.isfinite(least), least, -np.inf)

    @functools.cached_property
    def scatter(self) -> csr_array:
        """(C·d, M·n) adds up what constraints say of copies."""
        rows, count = self.at_copies.ravel(), self.copies.count * self.dimension
        kept = np.flatnonzero(rows < count)
        return coo_array((np.ones(len(kept)), (rows[kept], kept)), shape=(count, len(rows))).tocsr()

    def at_agents(self, x: Floats) -> Floats:
        """(C·d,) copies that agree with the (N, d) positions."""
        return x[self.copies.position].ravel()


@dataclass(frozen=True)
class Ends:
    """The ends of all links of all copies: what `consat.protocols.Links` is, in NumPy.

    Attributes:
        receiver: (E,) row at this end.
        other: (E,) the index of the other end.
        adding: (C, E) adds up the ends of each row.
        metropolis: (E,).
    """

    receiver: np.ndarray
    other: np.ndarray
    adding: csr_array
    metropolis: Floats

    @classmethod
    def of(cls, receiver: np.ndarray, sender: np.ndarray, count: int) -> Ends:
        here, there = receiver.astype(np.int64), sender.astype(np.int64)
        degree, ends = np.bincount(here, minlength=count), np.arange(len(here))
        adding = coo_array((np.ones(len(here)), (here, ends)), shape=(count, len(here))).tocsr()
        metropolis = 1.0 / (1.0 + np.maximum(degree[here], degree[there]))
        return cls(here, np.searchsorted(here * count + there, there * count + here), adding, metropolis)

    def at(self, rows: Floats) -> Floats:
        return rows[self.receiver]

    def across(self, ends: Floats) -> Floats:
        return ends[self.other]

    def sum(self, ends: Floats) -> Floats:
        return self.adding @ ends


def _longest(slack: Floats, slope: Floats, bend: Floats, part: Floats | float) -> Floats:
    """The longest step α with s + α p + ½ α² q ≥ (1 − part) s, for q ≤ 0, elementwise."""
    room = part * slack
    with np.errstate(divide="ignore"):
        return 2 * room / (-slope + np.sqrt(slope**2 - 2 * np.minimum(bend, 0.0) * room))


# --- exact steps ------------------------------------------------------------------------------------------------------------------------


def sweeps(arrays: Arrays, x: Floats, sigma: float, part: float) -> Rounds:
    """Margins after each EXACT Newton step of the primal-dual interior point, from positions (N, d): every one takes two sweeps of the tree.
    It ends where the barrier is at its floor.

    The same equations as `consat.protocols.interior_point`, solved for the whole team at once.
    """
    n = arrays.count * arrays.dimension
    y, at = np.append(x.ravel(), 0.0), np.column_stack([arrays.at_positions, np.full(len(arrays.owner), n)])
    at[at == n] = n + 1  # the padding, which is dropped
    at[:, -1] = n
    hessian = np.pad(arrays.hessian, ((0, 0), (0, 1), (0, 1)))
    rows, columns = np.broadcast_arrays(at[:, :, None], at[:, None, :])
    psi = arrays.psi(y[:-1, None], arrays.at_positions)[0][:, 0]
    y[-1] = psi.min() - max(1e-3, abs(psi.min()))
    slack = psi - y[-1]
    multiplier = (1 / slack) / np.sum(1 / slack)
    yield np.array([psi.min()])
    for _ in range(SWEEP_STEPS):
        psi, slope = arrays.psi(y[:-1, None], arrays.at_positions)
        slack = psi[:, 0] - y[-1]
        a = np.column_stack([slope[..., 0], -np.ones(len(slack))])
        barrier = sigma * (multiplier @ slack) / len(slack)
        if not barrier > SWEEP_FLOOR * max(1.0, abs(y[-1])):
            return
        matrix, vector = np.zeros((n + 2, n + 2)), np.zeros(n + 2)
        bowl = (multiplier / slack)[:, None, None] * a[:, :, None] * a[:, None, :] - multiplier[:, None, None] * hessian
        np.add.at(matrix, (rows, columns), bowl)
        np.add.at(vector, at, (barrier / slack)[:, None] * a)
        vector[n] += 1.0
        matrix = matrix[:-1, :-1] + SWEEP_INERTIA * np.eye(n + 1) + 1e-14 * np.diag(matrix.diagonal()[:-1])
        step = np.append(np.linalg.solve(matrix, vector[:-1]), 0.0)
        local = step[at]
        along = np.sum(a * local, axis=1)
        bend = np.einsum("mi,mij,mj->m", local, hessian, local)
        change = barrier / slack - multiplier - multiplier / slack * along
        falls = change < 0
        y = y + min(1.0, _longest(slack, along, bend, part).min()) * step[:-1]
        multiplier = multiplier + min(1.0, (part * multiplier[falls] / -change[falls]).min(initial=1.0)) * change
        yield np.array([arrays.psi(y[:-1, None], arrays.at_positions)[0].min()])


# --- the smooth objective ---------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Smooth:
    """f_i = e^{−ν_β α_i − shift} of every agent over its copies, one ν for each lane."""

    arrays: Arrays
    alpha: Floats
    beta: Floats
    shift: Floats

    def gradient(self, x: Floats) -> Floats:
        """∇f_i at (C, d·L) copies."""
        arrays, lanes = self.arrays, len(self.alpha)
        psi, slope = arrays.psi(x.reshape(-1, lanes), arrays.at_copies)
        _, starts, group = arrays.groups
        exponent = -self.alpha * psi
        top = np.maximum.reduceat(exponent, starts, axis=0)
        weight = np.exp(exponent - top[group])
        total = np.add.reduceat(weight, starts, axis=0)
        objective = np.exp(np.minimum(self.beta / self.alpha * (top + np.log(total)) - self.shift, STEEPEST))
        force = -self.beta * objective[group] * weight / total[group]
        return (arrays.scatter @ (force[:, None] * slope).reshape(-1, lanes)).reshape(x.shape)


def smooth(method: str, arrays: Arrays, starts: tuple[Floats, ...], nu: Nu, best: float) -> Rounds:
    """The paper's flow, sampled, with and without its ramp of ν_β, or EXTRA, as `peers` has them; from all starts, (N, d) each."""
    steps, ramps = (FLOW_STEPS, (False, True)) if method == "flow" else (EXTRA_STEPS, (False,))
    grid = np.meshgrid(np.arange(len(starts)), steps, NU, ramps, indexing="ij")
    which, step, factor, ramped = (part.ravel() for part in grid)
    shift = np.zeros(len(step)) if method == "flow" else -float(nu.beta) * factor * best  # the same as another step
    whole = Smooth(arrays, float(nu.alpha) * factor, float(nu.beta) * factor, shift)
    lanes, d = len(step), arrays.dimension
    x = np.stack([arrays.at_agents(start) for start in starts], axis=-1)[:, which].reshape(-1, d * lanes)
    links = Ends.of(*arrays.copies.edges.T, arrays.copies.count)
    wide = np.tile(step, d)

    def gradient(k: int) -> Callable[[Floats], Floats]:
        rise = np.minimum(1.0, peers.RAMP[0] + peers.RAMP[1] * step * k)
        return dataclasses.replace(whole, beta=whole.beta * np.where(ramped, rise, 1.0)).gradient

    def margin(state: Any) -> Floats:
        return arrays.margin(state[0].reshape(-1, lanes))

    yield arrays.margin(x.reshape(-1, lanes))
    state = peers.METHODS[method].begin(x, gradient(0), links, wide)
    k = 0
    if method == "extra":  # its beginning is a round already
        yield margin(state)
    while True:
        k += 1
        state = peers.METHODS[method].round(state, gradient(k), links, wide)
        yield margin(state)


# --- the epigraph -----------------------------------------------------------------------------------------------------------------------


def subgradient(arrays: Arrays, x: Floats) -> Rounds:
    """Mix with the neighbours, raise the own level by h k^−p, and go back to where the own constraints hold (Nedić, Ozdaglar, Parrilo 2010).

    y_i, t_i ← Σ_j w_ij (y_j, t_j);  t_i ← t_i + h k^−p;  then `PASSES` times, of the own constraint most violated, with a = (∇ψ, −1),
    (y_i, t_i) ← (y_i, t_i) + (t_i − ψ)/‖a‖² a.
    """
    step, decay = (part.ravel() for part in np.meshgrid(SUBGRADIENT_STEPS, SUBGRADIENT_DECAY, indexing="ij"))
    lanes, d = len(step), arrays.dimension
    agents, starts, group = arrays.groups
    y = np.repeat(arrays.at_agents(x)[:, None], lanes, axis=1)
    t = np.zeros((arrays.count, lanes))
    ends, talks = Ends.of(*arrays.copies.edges.T, arrays.copies.count), Ends.of(*_both_ways(arrays.links, arrays.count).T, arrays.count)
    k = 0
    while True:
        yield arrays.margin(y)
        k += 1
        rows = y.reshape(-1, d * lanes)
        y = (rows - _mixed(ends, rows)).reshape(y.shape)
        t = t - _mixed(talks, t) + step * float(k) ** -decay
        for _ in range(PASSES):
            psi, slope = arrays.psi(y, arrays.at_copies)
            excess = t[arrays.owner] - psi
            worst = (excess >= np.maximum.reduceat(excess, starts, axis=0)[group]) & (excess > 0)
            move = np.where(worst, excess / (np.sum(slope**2, axis=1) + 1.0), 0.0)
            y = y + arrays.scatter @ (move[:, None] * slope).reshape(-1, lanes)
            t[agents] -= np.add.reduceat(move, starts, axis=0)


def _mixed(ends: Ends, rows: Floats) -> Floats:
    at = ends.at(rows)
    return ends.sum(ends.metropolis[:, None] * (at - ends.across(at)))


def _both_ways(links: np.ndarray, count: int) -> np.ndarray:
    pairs = np.concatenate([links, links[:, ::-1]]).astype(np.int64)
    return pairs[np.argsort(pairs[:, 0] * count + pairs[:, 1])]


def dual(arrays: Arrays, x: Floats) -> Rounds:
    """Dual decomposition: multipliers v say that neighbours' copies and levels agree, and each agent solves its own problem exactly.

    p = v + γ A z;   z_i ← argmax t_i − (Aᵀp)_i·z_i − ρ/2 ‖z_i − z_i_before‖² with ψ_ik(y_i) ≥ t_i;   v ← v + γ A z

    Without the proximal term an agent's problem has no bound, since nothing but others ties it to a place; with it this is the
    predictor-corrector method of multipliers (Chen, Teboulle 1994), one round an iteration.
    """
    lanes, d, count = len(DUAL_WEIGHTS), arrays.dimension, arrays.count
    local, agreement, total = _Local.of(arrays), _agreement(arrays), arrays.copies.count * d
    rho = DUAL_WEIGHTS / count
    gamma = DUAL_PART * rho / (2 * np.abs(agreement).sum(axis=0).max())
    z = np.repeat(np.append(arrays.at_agents(x), np.zeros(count))[:, None], lanes, axis=1)
    v, multiplier = np.zeros((agreement.shape[0], lanes)), np.zeros((lanes, *local.value.shape))
    first = True
    while True:
        yield arrays.margin(z[:total])
        push = -(agreement.T @ (v + gamma * (agreement @ z)))
        push[total:] += 1.0 / count
        z, multiplier = local.solve(z, push, rho, multiplier, FIRST_STEPS if first else LOCAL_STEPS)
        v = v + gamma * (agreement @ z)
        first = False


def _agreement(arrays: Arrays) -> csr_array:
    """(equations, C·d + N) one row for each number that the two ends of a link share: a copy's coordinates, or the level."""
    d, count = arrays.dimension, arrays.copies.count
    edges = arrays.copies.edges[arrays.copies.edges[:, 0] < arrays.copies.edges[:, 1]]
    pairs = np.concatenate([(edges[:, None] * d + np.arange(d)[None, :, None]).reshape(-1, 2), count * d + arrays.links])
    rows = np.repeat(np.arange(len(pairs)), 2)
    return coo_array((np.tile([1.0, -1.0], len(pairs)), (rows, pairs.ravel())), shape=(len(pairs), count * d + arrays.count)).tocsr()


@dataclass(frozen=True)
class _Local:
    """Every agent's own problem, padded to n variables, the level last, and m constraints, which hold anywhere where padded.

    Attributes:
        place: (N, n) where an agent's variables stand among the C·d + N; padded past the last.
        value: (N, m).
        gradient: (N, m, n).
        hessian: (N, m, n, n).
    """

    place: np.ndarray
    value: Floats
    gradient: Floats
    hessian: Floats

    @classmethod
    def of(cls, arrays: Arrays) -> _Local:
        d, copies, count = arrays.dimension, arrays.copies, arrays.count
        held = np.bincount(copies.holder, minlength=count)
        begins = np.cumsum(held) - held
        width, total = int(held.max()) * d + 1, copies.count * d
        place = np.full((count, width), total + count)
        for i in range(count):
            place[i, : held[i] * d] = begins[i] * d + np.arange(held[i] * d)
        place[:, -1] = total + np.arange(count)
        slot = np.where(arrays.at_copies < total, arrays.at_copies - begins[arrays.owner][:, None] * d, width)  # the padding is dropped
        _, starts, group = arrays.groups
        rank = np.arange(len(arrays.owner)) - starts[group]
        most = int(rank.max()) + 1
        value, gradient = np.ones((count, most)), np.zeros((count, most, width + 1))
        hessian = np.zeros((count, most, width + 1, width + 1))
        value[arrays.owner, rank] = arrays.value
        gradient[arrays.owner[:, None], rank[:, None], slot] = arrays.gradient
        gradient[arrays.owner, rank, width - 1] = -1.0
        who, which = arrays.owner[:, None, None], rank[:, None, None]
        hessian[who, which, slot[:, :, None], slot[:, None, :]] = arrays.hessian
        return cls(place, value, gradient[..., :-1], hessian[..., :-1, :-1])

    def solve(self, z: Floats, push: Floats, rho: Floats, multiplier: Floats, steps: int) -> tuple[Floats, Floats]:
        """argmax push·z − ρ/2 ‖z − z₀‖² with all own ψ ≥ t, from z₀ = z, (C·d + N, L), and (L, N, m) multipliers.

        Projected Newton steps on the dual, g(λ) = max_z push·z − ρ/2 ‖z − z₀‖² + Σ λ_k (ψ_k − t), whose gradient is the slack.
        """
        lanes, width = z.shape[1], self.place.shape[1]
        before, force = (np.moveaxis(np.concatenate([each, np.zeros((1, lanes))])[self.place], -1, 0) for each in (z, push))
        weight, eye = rho[:, None, None], np.eye(self.value.shape[1])

        def best(multiplier: Floats) -> tuple[Floats, Floats]:
            matrix = weight[..., None] * np.eye(width) - np.einsum("lik,ikab->liab", multiplier, self.hessian)
            vector = force + weight * before + np.einsum("lik,ika->lia", multiplier, self.gradient)
            return matrix, np.linalg.solve(matrix, vector[..., None])[..., 0]

        for _ in range(steps):
            matrix, now = best(multiplier)
            bent = np.matmul(self.hessian, now[:, :, None, :, None])[..., 0]
            a = self.gradient + bent
            slack = self.value + np.sum((a - 0.5 * bent) * now[:, :, None], axis=-1)
            free = (multiplier > 0) | (slack < 0)
            bend = np.matmul(a, np.linalg.solve(matrix, np.swapaxes(a, -1, -2)))
            bend = np.where(free[..., None] & free[..., None, :], bend, 0.0) + np.where(free[..., None], 1e-12, 1.0) * eye
            multiplier = np.maximum(multiplier - np.linalg.solve(bend, np.where(free, slack, 0.0)[..., None])[..., 0], 0.0)
        whole = np.zeros((z.shape[0] + 1, lanes))
        whole[self.place] = np.moveaxis(best(multiplier)[1], 0, -1)
        return whole[:-1], multiplier
