"""Random small problems of the safety filter, and piqp's answers to them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import piqp


class Problems(NamedTuple):
    """The nearest velocity to `wish`, (N, d), with normals·u ≥ least; normals: (N, k, d) unit vectors; least: (N, k)."""

    wish: np.ndarray
    normals: np.ndarray
    least: np.ndarray


class Answers(NamedTuple):
    """point: (N, d); there: (N,) whether there is one; exact: (N,) whether piqp came to its tolerance, or else ran out of digits."""

    point: np.ndarray
    there: np.ndarray
    exact: np.ndarray


def problems(count: int, dimension: int, rows: int, seed: int) -> Problems:
    """Random ones, of which some have no answer; one in ten has two rows that face each other."""
    rng = np.random.default_rng(seed)
    normals = rng.normal(size=(count, rows, dimension))
    if rows > 1:
        normals[:, 1] = np.where(rng.random((count, 1)) < 0.1, -normals[:, 0], normals[:, 1])
    normals /= np.linalg.norm(normals, axis=2)[..., None]
    return Problems(rng.normal(size=(count, dimension)), normals, rng.uniform(-0.5, 0.15, (count, rows)))


def solved(asked: Problems) -> Answers:
    """By piqp, one after the other, as exactly as it can."""
    count, rows, dimension = asked.normals.shape
    answers = Answers(np.zeros((count, dimension)), np.zeros(count, dtype=bool), np.zeros(count, dtype=bool))
    for index, (wish, normals, least) in enumerate(zip(*asked, strict=True)):
        solver = piqp.DenseSolver()
        settings = solver.settings
        settings.eps_abs, settings.eps_rel, settings.eps_duality_gap_abs, settings.eps_duality_gap_rel = 1e-11, 0.0, 1e-12, 0.0
        solver.setup(np.eye(dimension), -wish, None, None, normals, least, np.full(rows, 1e30))
        status = solver.solve()
        answers.point[index] = solver.result.x
        answers.there[index] = status != piqp.PIQP_PRIMAL_INFEASIBLE
        answers.exact[index] = status == piqp.PIQP_SOLVED
    return answers


SIZES = ((1, 4), (2, 8), (2, 12), (3, 8), (3, 12))
"""Dimensions and rows of the problems that are compared."""
BLOCK = 20_000


class Compared(NamedTuple):
    """The filter beside piqp, on problems of one size.

    Attributes:
        dimension: d.
        rows: k.
        count: how many.
        infeasible: how many have no answer.
        undecided: on how many piqp ran out of digits.
        differ: on how many they differ in whether there is an answer.
        wrong: on how many of these two the filter says otherwise than a linear program (HiGHS).
        apart: the farthest that their answers lie apart, m/s.
        farther: the most that the filter's answer is farther from the wish than piqp's, m/s.
        violated: the most that the filter's answer violates a row, m/s.
    """

    dimension: int
    rows: int
    count: int
    infeasible: int
    undecided: int
    differ: int
    wrong: int
    apart: float
    farther: float
    violated: float


def compared(count: int) -> list[Compared]:
    """So many problems in all, with float64 in JAX."""
    import jax

    from consat.robots.filter import nearest

    solve, found = jax.jit(nearest), []
    for dimension, rows in SIZES:
        parts, left = [], count // len(SIZES)
        while left:
            asked = problems(min(BLOCK, left), dimension, rows, seed=1 + left)
            left -= len(asked.wish)
            point, there = map(np.asarray, solve(*asked, np.full(len(asked.wish), 1e3)))
            parts.append(_part(asked, point, there, solved(asked)))
        columns = list(zip(*parts, strict=True))
        found.append(Compared(dimension, rows, *map(sum, columns[:5]), *map(max, columns[5:])))
    return found


def _part(asked: Problems, point: np.ndarray, there: np.ndarray, answers: Answers) -> tuple[int | float, ...]:
    undecided, differ = answers.there & ~answers.exact, answers.there != there
    differ &= ~undecided
    wrong = [index for index in np.flatnonzero(undecided | differ) if _feasible(asked.normals[index], asked.least[index]) != there[index]]
    both = there & answers.exact
    apart = np.abs(point - answers.point).max(axis=1, initial=0.0)[both].max(initial=0.0)
    farther = np.linalg.norm(point - asked.wish, axis=1) - np.linalg.norm(answers.point - asked.wish, axis=1)
    violated = (asked.least - np.einsum("nkd,nd->nk", asked.normals, point))[there].max(initial=0.0)
    worst = float(apart), float(farther[both].max(initial=0.0)), float(violated)
    return len(there), int((~there).sum()), int(undecided.sum()), int(differ.sum()), len(wrong), *worst


def _feasible(normals: np.ndarray, least: np.ndarray) -> bool:
    """Whether normals·u ≥ least has an answer: the best margin of all rows is not negative."""
    from scipy.optimize import linprog

    rows, dimension = normals.shape
    best = linprog([*np.zeros(dimension), -1.0], np.c_[-normals, np.ones(rows)], -least, bounds=[(-1e3, 1e3)] * dimension + [(None, 1.0)])
    return bool(best.x[-1] >= 0.0)
