"""What else finds such a formation: the paper's flow sampled by forward Euler, gradient tracking and EXTRA on the same f, and packages.

A lane is one choice of step, of ν (the paper's ramp, or constant) and of starts; all lanes of a method run at once.
"""

from __future__ import annotations

import functools
import sys
from collections.abc import Callable, Mapping
from importlib.util import find_spec
from typing import Any, Final, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from consat.engine.world import Everyone
from consat.numerics import quick_compilation
from consat.problem.objective import Nu

RAMP = (0.002, 0.0044)
"""Start, and rise in a second, of the paper's ramp of ν_β, as fractions of its end (0.01 and 0.022 of 5)."""


class Lanes(NamedTuple):
    """Leading axis: the lanes.

    Attributes:
        box: which of the boxes, int.
        step: h.
        ramped: 1.0 with the ramp, 0.0 with constant ν.
        first: (lanes, C, d).
        alpha: ν_α.
        beta: ν_β, in the end.
    """

    box: np.ndarray
    step: Array
    ramped: Array
    first: Array
    alpha: Array
    beta: Array


class Method(NamedTuple):
    """How to begin from first estimates, and one round; `gradient` maps estimates and a round to ∇f_i."""

    title: str
    begin: Callable[..., Any]
    round: Callable[..., Any]


def lanes(steps: np.ndarray, first: np.ndarray, nu: Nu) -> Lanes:
    """Every step, with and without the ramp, from every one of the (boxes, C, d) first estimates."""
    box, step, ramped = (part.ravel() for part in np.meshgrid(np.arange(len(first)), steps, [0.0, 1.0], indexing="ij"))
    alpha, beta = (jnp.full(len(box), float(value)) for value in (nu.alpha, nu.beta))
    return Lanes(box, jnp.asarray(step), jnp.asarray(ramped), jnp.asarray(first)[box], alpha, beta)


def _difference(links: Any, x: Array, weight: Array | float) -> Array:
    """Σ_j w_ij (x_i − x_j)."""
    at = links.at(x)
    return links.sum(weight * (at - links.across(at)))


def _flow_begin(x: Array, *_: Any) -> Any:
    return x, 0.0 * x


def _flow_round(state: Any, gradient: Callable[[Array], Array], links: Any, step: Array) -> Any:
    """x⁺ = x + h (−∇f − Lx − z),  z⁺ = z + h Lx: the paper's gradient flow, k1 = k2 = 1."""
    x, z = state
    spread = _difference(links, x, 1.0)
    return x + step * (-gradient(x) - spread - z), z + step * spread


def _tracking_begin(x: Array, gradient: Callable[[Array], Array], *_: Any) -> Any:
    g = gradient(x)
    return x, g, g


def _tracking_round(state: Any, gradient: Callable[[Array], Array], links: Any, step: Array) -> Any:
    """x⁺ = Wx − h y,  y⁺ = Wy + ∇f(x⁺) − ∇f(x): DIGing (Nedić, Olshevsky, Shi 2017)."""
    x, y, g = state
    w = links.metropolis[:, None]
    x = x - _difference(links, x, w) - step * y
    fresh = gradient(x)
    return x, y - _difference(links, y, w) + fresh - g, fresh


def _extra_begin(x: Array, gradient: Callable[[Array], Array], links: Any, step: Array) -> Any:
    g, spread = gradient(x), _difference(links, x, links.metropolis[:, None])
    return x - spread - step * g, x - 0.5 * spread, g


def _extra_round(state: Any, gradient: Callable[[Array], Array], links: Any, step: Array) -> Any:
    """x⁺⁺ = (I + W) x⁺ − ½(I + W) x − h (∇f(x⁺) − ∇f(x)): EXTRA (Shi, Ling, Wu, Yin 2015)."""
    x, half_mixed, g = state
    fresh, spread = gradient(x), _difference(links, x, links.metropolis[:, None])
    return 2 * x - spread - half_mixed - step * (fresh - g), x - 0.5 * spread, fresh


METHODS: Final[Mapping[str, Method]] = {
    "flow": Method("sampled flow", _flow_begin, _flow_round),
    "tracking": Method("gradient tracking", _tracking_begin, _tracking_round),
    "extra": Method("EXTRA", _extra_begin, _extra_round),
}
ARRAYS: Final = {"flow": 1, "tracking": 2, "extra": 1}
"""Vectors sent for each copy in a round."""


def _gradient(everyone: Everyone, lane: Lanes, round_: Array) -> Callable[[Array], Array]:
    ramp = lane.beta * jnp.minimum(1.0, RAMP[0] + RAMP[1] * lane.step * round_)
    nu = Nu(lane.alpha, jnp.where(lane.ramped > 0, ramp, lane.beta))

    return lambda x: everyone.local.gradient(x, nu)


@functools.partial(jax.jit, static_argnames=("method",), compiler_options=quick_compilation())
def _start(method: str, everyone: Everyone, lanes: Lanes) -> Any:
    def one(lane: Lanes) -> Any:
        return METHODS[method].begin(lane.first, _gradient(everyone, lane, jnp.zeros(())), everyone.links, lane.step)

    return jax.vmap(one)(lanes)


def start(method: str, everyone: Everyone, lanes: Lanes) -> Any:
    """The state of every lane."""
    return _start(method, everyone, lanes._replace(box=jnp.asarray(lanes.box)))


@functools.partial(jax.jit, static_argnames=("method", "look"), compiler_options=quick_compilation())
def _go_on(method: str, everyone: Everyone, look: Any, own: Array, looked: Any, state: Any, lanes: Lanes, rounds: Array) -> Any:
    def one(state: Any, lane: Lanes) -> Any:
        def step(state: Any, round_: Array) -> Any:
            state = METHODS[method].round(state, _gradient(everyone, lane, round_ + 1.0), everyone.links, lane.step)
            return state, look(*looked, state[0][own])

        return jax.lax.scan(step, state, rounds)

    return jax.vmap(one)(state, lanes)


def go_on(
    method: str, everyone: Everyone, look: Any, looked: Any, own: Array, state: Any, lanes: Lanes, rounds: Array
) -> tuple[Any, tuple[np.ndarray, np.ndarray]]:
    """Some rounds of every lane: the state, and what `look(*looked, positions)` saw, (lanes, rounds, S) each."""
    state, seen = _go_on(method, everyone, look, own, looked, state, lanes._replace(box=jnp.asarray(lanes.box)), rounds)
    return state, tuple(np.asarray(part) for part in seen)  # type: ignore[return-value]


# --- packages ---------------------------------------------------------------------------------------------------------------------------


def packages(*, quick: bool) -> str:
    """What packages for distributed optimisation do with the paper's case A, as markdown; or why they take no part."""
    lines = []
    if find_spec("tvopt") is None:
        lines.append("* tvopt: not installed (`pip install tvopt`); skipped.")
    else:
        lines.append(_tvopt(quick=quick))
    if find_spec("decent_bench") is None:
        need = (
            f"needs Python ≥ 3.13, this is {sys.version_info[0]}.{sys.version_info[1]}" if sys.version_info < (3, 13) else "not installed"
        )
        lines.append(f"* decent-bench: {need}; skipped.")
    else:
        lines.append("* decent-bench: installed, but measured by its own command only; skipped.")
    lines.append(
        "* disropt: " + ("not installed (needs MPI)" if find_spec("disropt") is None else "needs one MPI process an agent") + "; skipped."
    )
    return "\n".join(lines)


def _tvopt(*, quick: bool) -> str:
    """Case A in tvopt, ν = 5: each agent estimates all positions."""
    import tvopt  # noqa: F401
    from tvopt import costs, distributed_solvers, networks, sets

    nu, center, optimum = 5.0, np.array([2.0, 0.0]), np.tile([2.0, 0.0], 3)

    class Exponential(costs.Cost):  # type: ignore[misc]
        """f_i = exp(−ν ψ_i) of the paper's case A, with its gradient by hand."""

        def __init__(self, i: int) -> None:
            super().__init__(sets.R(6, 1))
            self.i, self.smooth = i, 2

        def away(self, x: np.ndarray) -> np.ndarray:
            x = x.reshape(3, 2)
            return x[0] - center if self.i == 0 else x[self.i] - x[self.i - 1]

        def gradient(self, x: np.ndarray, *_: Any, **__: Any) -> np.ndarray:
            away = self.away(x)
            g = np.zeros((3, 2))
            g[self.i] = away
            if self.i:
                g[self.i - 1] = -away
            return (2 * nu * np.exp(-nu * (1 - away @ away)) * g).reshape(6, 1)

    class Watched(costs.SeparableCost):  # type: ignore[misc]
        """Keeps the positions at which gradients were asked for: one a round."""

        def gradient(self, x: np.ndarray, *args: Any, **kwargs: Any) -> np.ndarray:
            self.seen.append(np.stack([x[2 * i : 2 * i + 2, 0, i] for i in range(3)]))
            return super().gradient(x, *args, **kwargs)

    solvers = {"PG-EXTRA": (distributed_solvers.pg_extra, 1), "AugDGM": (distributed_solvers.aug_dgm, 2)}
    network = networks.Network(np.array([[0, 1, 0], [1, 0, 1], [0, 1, 0]]))
    seeds, rounds, steps = (2, 400, (0.01, 0.05)) if quick else (5, 2000, (0.003, 0.01, 0.02, 0.03, 0.05, 0.1))
    parts = []
    for name, (solver, messages) in solvers.items():
        for label, half in (("x* ± 0.5", 0.5), ("±4", 4.0)):
            best = (0, np.inf, np.nan)
            for step in steps:
                taken = []
                for seed in range(seeds):
                    random = np.random.default_rng(seed)
                    first = (optimum if half < 1 else 0.0) + random.uniform(-half, half, (3, 6))
                    f = Watched([Exponential(i) for i in range(3)])
                    f.seen = []
                    with np.errstate(all="ignore"):
                        solver({"f": f, "network": network}, step, first.T[:, None, :], rounds)
                    taken.append(_satisfied(np.stack(f.seen), center) * messages)
                reached = int(np.isfinite(taken).sum())
                median = float(np.nanmedian(taken)) if reached else np.inf
                best = max(best, (reached, median, step), key=lambda b: (b[0], -b[1]))
            text = f"{best[1]:.0f} rounds, {best[0]} of {seeds} starts, step {best[2]:g}" if best[0] else "never (overflows)"
            parts.append(f"  * {name} from {label}: {text}")
    note = "satisfied for good at its best step; AugDGM sends two messages an iteration"
    return "\n".join([f"* tvopt {_version('tvopt')}, case A, full estimates, constant ν = 5, {note}:", *parts])


def _version(name: str) -> str:
    from importlib.metadata import version

    return version(name)


def _satisfied(x: np.ndarray, center: np.ndarray) -> float:
    """The round after the last one that was not satisfied; NaN if that is the last."""
    away = np.stack([x[:, 0] - center, x[:, 1] - x[:, 0], x[:, 2] - x[:, 1]], axis=1)
    good = np.nan_to_num(1 - (away**2).sum(axis=2).max(axis=1), nan=-1.0) > 0
    last = np.flatnonzero(~good).max(initial=-1)
    return float(last + 1) if last + 10 < len(good) else np.nan
