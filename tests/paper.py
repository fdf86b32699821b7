"""The paper's equations, written again with plain NumPy and SciPy and nothing of consat's: what the package is held against."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.integrate import solve_ivp

Psi = Callable[[np.ndarray], tuple[float, np.ndarray]]
"""ψ and its gradient at all positions, (3, 2)."""


def disc(i: int, center: tuple[float, float], radius: float) -> Psi:
    def psi(x: np.ndarray) -> tuple[float, np.ndarray]:
        away, gradient = x[i] - center, np.zeros_like(x)
        gradient[i] = -2 * away
        return radius**2 - away @ away, gradient

    return psi


def link(i: int, j: int, radius: float, sign: float = 1.0) -> Psi:
    """sign = 1: nearer than the radius; −1: farther."""

    def psi(x: np.ndarray) -> tuple[float, np.ndarray]:
        away, gradient = x[i] - x[j], np.zeros_like(x)
        gradient[i], gradient[j] = -2 * sign * away, 2 * sign * away
        return sign * (radius**2 - away @ away), gradient

    return psi


def _tug(near: float, nearer: float) -> list[list[Psi]]:
    return [[disc(0, (2, 0), 1)], [link(1, 0, near), link(1, 2, nearer)], [disc(2, (-2, 0), 1)]]


CASES: dict[str, list[list[Psi]]] = {
    "case-a": [[disc(0, (2, 0), 1)], [link(1, 0, 1)], [link(2, 1, 1)]],
    "case-b": _tug(3, 2),
    "case-c": _tug(1.7, 0.7),
    "case-d": _tug(1.4, 0.4),
    "case-e": [
        [disc(0, (2, 0), 1)],
        [link(1, 0, 1), link(1, 0, 0.2, -1)],
        [link(2, 1, 1), link(2, 0, 1), link(2, 0, 0.2, -1), link(2, 1, 0.2, -1)],
    ],
}
NU_ALPHA = 5.0
LAPLACIAN = np.array([[1.0, -1, 0], [-1, 2, -1], [0, -1, 1]])


def nu_beta(time: float) -> float:
    return min(0.022 * time + 0.01, 5.0)


def log_objective(constraints: list[Psi], x: np.ndarray, nu: float) -> float:
    """ln f_i (paper, eq. 14 and 15)."""
    psi = np.array([c(x)[0] for c in constraints])
    low = psi.min()
    return nu / NU_ALPHA * (np.log(np.exp(-NU_ALPHA * (psi - low)).sum()) - NU_ALPHA * low)


def gradient(constraints: list[Psi], x: np.ndarray, nu: float) -> np.ndarray:
    """∇f_i (paper, eq. 17): −ν_β h^(ν_β/ν_α − 1) Σ e^{−ν_α ψ} ∇ψ, with h e^{…} brought to one exponent."""
    pairs = [c(x) for c in constraints]
    psi = np.array([value for value, _ in pairs])
    log_h = log_objective(constraints, x, NU_ALPHA)
    weights = np.exp(-NU_ALPHA * psi + (nu / NU_ALPHA - 1) * log_h)
    return -nu * sum(w * g for w, (_, g) in zip(weights, pairs, strict=True))


def integrate(case: str, protocol: str, first: np.ndarray, times: np.ndarray, **options: float) -> tuple[np.ndarray, np.ndarray]:
    """Estimates and integral states (T, 3, 3, 2) from first estimates (3, 3, 2), by LSODA.

    Axes: time, who estimates, whose position, coordinate.
    """
    agents = CASES[case]

    def rate(time: float, flat: np.ndarray) -> np.ndarray:
        x, z = flat.reshape(2, 3, 3, 2)
        grad = np.stack([gradient(constraints, x[i], nu_beta(time)) for i, constraints in enumerate(agents)])
        spread = np.einsum("ij,jkl->ikl", LAPLACIAN, x)
        if protocol == "gradient-flow":
            return np.stack([-grad - spread - z, spread]).ravel()
        return np.stack([-grad - spread - np.einsum("ij,jkl->ikl", LAPLACIAN, z), spread]).ravel()

    start = np.stack([first, np.zeros_like(first)]).ravel()
    options = {"rtol": 1e-9, "atol": 1e-11} | options
    solution = solve_ivp(rate, (times[0], times[-1]), start, method="LSODA", t_eval=times, **options)
    if not solution.success:
        raise RuntimeError(solution.message)
    states = solution.y.T.reshape(len(times), 2, 3, 3, 2)
    return states[:, 0], states[:, 1]
