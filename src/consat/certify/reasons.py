"""Explains in sentences what limits the margin of a team: which constraints conflict or bind, and the smallest change that would help.

Multipliers show which constraints conflict, and how much the margin increases if one is relaxed: dβ̄*/dp = λ_k ∂ψ_k/∂p. They only guide the
search. A conflict is stated only if the named constraints alone are proven incompatible. A cure is stated only if the changed team is
solved again and satisfies all constraints of the cluster.
"""

from __future__ import annotations

import dataclasses
import functools
import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from consat.certify.certificate import BINDING, bounds
from consat.certify.optimum import Optimum, cluster_margins, max_min
from consat.certify.quadratics import Bools, Floats, values_and_gradients
from consat.numerics import float64
from consat.problem.family import Family
from consat.problem.graphs import clusters
from consat.problem.team import Team

NAMED = 6
"""Largest number of constraints named in a sentence; of more, those with the largest multipliers are named."""
TRIED = 3
"""Number of binding constraints that are tried as the one to relax."""
SOLVES = 12
"""Largest number of solutions in each of the two searches (a sufficient relaxation, then the smallest) for one constraint."""
MOST_SOLVED = 2000
"""Above this many constraints in a cluster no cure is searched, because each trial solves the cluster again."""
LEAST = 1e-6
"""Smallest relaxation to propose, relative to the number that is relaxed."""
DIGITS = 2
"""Number of significant digits to which a proposed change is rounded up."""


@dataclass(frozen=True)
class _Knob:
    """One number of one constraint that can be changed to relax it.

    Attributes:
        constraint: index of the constraint in the team's order.
        parameter: name of the parameter; "" stands for the value of ψ itself.
        entry: index of the number within the parameter.
        now: current value of the number.
        gain: increase of β̄* per unit of relaxation, > 0.
        sign: +1 if the number must increase to relax the constraint, −1 if it must decrease.
    """

    constraint: int
    parameter: str
    entry: tuple[int, ...]
    now: float
    gain: float
    sign: float


def explain(team: Team, optimum: Optimum) -> list[str]:
    """Sentences that explain what limits the margin of a team, cluster by cluster.

    Args:
        team: the team.
        optimum: its optimum from `consat.certify.optimum.max_min`.
    """
    if not len(team.owner):
        return ["No agent has a constraint."]
    if optimum.unbounded:
        return ["Nothing limits the margin: the constraints can hold with any margin one likes."]
    cluster = clusters(team)
    values = values_and_gradients(team, optimum.positions)[0]
    margins = cluster_margins(team, values, cluster)
    sentences: list[str] = []
    for c in np.flatnonzero(margins < np.inf):
        mine = cluster[team.owner] == c
        if margins[c] == -np.inf:
            nowhere = np.flatnonzero(mine & (values == -np.inf)).tolist()
            sentences.append(f"No formation was found at which ψ of {_listed(team, nowhere)} is a finite number.")
        elif margins[c] <= 0:
            sentences += _conflict(team, optimum, mine, float(margins[c]))
    if not sentences:
        worst = int(np.argmin(margins))
        binding = _binding(optimum.multipliers, cluster[team.owner] == worst)
        best = "best margin" if optimum.exact else "best margin found"
        sentences.append(f"Every constraint can hold. The {best} is {_number(optimum.margin)}, limited by {_listed(team, binding)}.")
    return sentences


def _binding(multipliers: Floats, mine: Bools) -> list[int]:
    """Indices of the binding constraints, the largest multiplier first. The threshold is relative: in a large team all are small."""
    heavy = np.flatnonzero(mine & (multipliers > BINDING * np.max(multipliers[mine], initial=0.0)))
    return [int(k) for k in heavy[np.argsort(-multipliers[heavy], kind="stable")]]


def _conflict(team: Team, optimum: Optimum, mine: Bools, margin: float) -> Iterator[str]:
    binding = _binding(optimum.multipliers, mine)
    chosen = np.zeros(len(team.owner), dtype=bool)
    chosen[binding] = True
    if _infeasible(team, optimum, chosen):
        together = {1: "", 2: "both "}.get(len(binding), "all ")
        sentence = f"{_listed(team, binding)} cannot {together}hold: the best margin is {_number(margin)}."
    elif _infeasible(team, optimum, mine):
        sentence = f"Not all constraints can hold: the best margin is {_number(margin)}. In the way are {_listed(team, binding)}."
    else:
        sentence = f"No formation was found in which {_listed(team, binding)} hold together: the best margin found is {_number(margin)}."
    cure = _cure(restricted(team, mine), optimum.multipliers[mine], optimum.positions, margin) if mine.sum() <= MOST_SOLVED else None
    yield f"{sentence} {cure}" if cure else sentence


def _infeasible(team: Team, optimum: Optimum, keep: Bools) -> bool:
    """Whether the constraints of an (M,) mask are proven incompatible on their own."""
    return bounds(restricted(team, keep), optimum.positions, multipliers=optimum.multipliers[keep]).verdict == "infeasible"


def _cure(team: Team, multipliers: Floats, positions: Floats, margin: float) -> str | None:
    """A sentence with the smallest relaxation of one constraint that satisfies the cluster when solved again; None if none is found.

    Constraints whose relaxation helps most, relative to the size of the number, are tried first.
    """
    knobs = sorted(_knobs(team, multipliers, positions), key=lambda knob: -knob.gain * max(abs(knob.now), 1e-300))
    for knob in knobs[:TRIED]:
        amount = _least(functools.partial(_margin, team, knob), -margin / knob.gain, LEAST * (abs(knob.now) or 1.0), margin)
        if amount is not None:
            return _proposal(team, knob, amount)
    return None


def _margin(team: Team, knob: _Knob, amount: float) -> float:
    return max_min(turned(team, knob, amount)).margin


def _least(solve: Callable[[float], float], guess: float, least: float, margin: float) -> float | None:
    """The smallest amount with a positive margin, rounded up; None if none is found.

    Args:
        solve: margin as a function of the amount; assumed to increase.
        guess: first amount to try.
        least: smallest amount to try.
        margin: margin for amount 0, not positive.
    """
    low, high, below = 0.0, max(guess, least), margin
    for tries in range(SOLVES):
        above = solve(high)
        if above > 0:
            break
        if not math.isfinite(above) or (above <= below + 1e-9 * abs(margin) and tries > 1):
            return None  # more of it does not help: another constraint limits the margin
        slope = (above - below) / (high - low)
        low, high, below = high, min(high + 1.05 * abs(above) / slope, 4 * high) if slope > 0 else 2 * high, above
    else:
        return None
    for _ in range(SOLVES):
        rounded = _rounded_up(low) if low else 0.0
        if rounded >= _rounded_up(high) or high <= least:
            break
        middle = low + (high - low) * max(0.1, min(0.9, -below / (above - below)))
        value = solve(middle)
        if value > 0:
            high, above = middle, value
        else:
            low, below = middle, value
    amount = _rounded_up(high)
    return amount if solve(amount) > 0 else None


def _rounded_up(amount: float) -> float:
    step = 10.0 ** (math.floor(math.log10(amount)) + 1 - DIGITS)
    return float(f"{math.ceil(amount / step * (1 - 1e-12)) * step:.{DIGITS}g}")


@float64
def _knobs(team: Team, multipliers: Floats, positions: Floats) -> list[_Knob]:
    """The numbers that can be relaxed in binding constraints: a radius, an offset or the side of a box; for other kinds ψ itself."""
    knobs = []
    for family in team.families:
        for member in np.flatnonzero(multipliers[family.number] > BINDING):
            k = int(family.number[member])
            weight, parameters = float(family.weight[member]), {key: value[member] for key, value in family.parameters.items()}
            slopes = _slopes(family, positions[family.agents[member]], parameters)
            options = [
                (abs(slope), name, entry, slope)
                for name in ("radius", "offset", "low", "high")
                if name in parameters
                for entry, slope in np.ndenumerate(slopes[name])
                if slope != 0 and math.isfinite(slope)
            ]
            if family.kind in STANDARD and options:
                _, name, entry, slope = max(options)
                now = float(parameters[name][entry])
                knobs.append(_Knob(k, name, entry, now, multipliers[k] * weight * abs(slope), math.copysign(1.0, slope)))
            else:
                values = values_and_gradients(team, positions)[0]
                size = float(np.abs(values[np.isfinite(values)]).max(initial=0.0)) / weight
                knobs.append(_Knob(k, "", (), size, multipliers[k] * weight, 1.0))
    return knobs


STANDARD = ("within", "outside", "near", "apart", "displacement", "halfspace", "box")
"""Library kinds, whose parameters can be named in a proposal."""


def _slopes(family: Family, arguments: Floats, parameters: dict[str, Floats]) -> dict[str, Floats]:
    """∂ψ/∂p of one member, for each of its parameters."""
    slopes: dict[str, jax.Array] = jax.grad(lambda varied: family.psi(*jnp.asarray(arguments), **varied))(parameters)
    return {key: np.asarray(value) for key, value in slopes.items()}


@dataclass(frozen=True)
class _Slackened:
    """The function ψ + slack, with the parameter ``slack``."""

    psi: Callable[..., Any]

    def __call__(self, *positions: Any, slack: Any, **parameters: Any) -> Any:
        return self.psi(*positions, **parameters) + slack


def turned(team: Team, knob: _Knob, amount: float) -> Team:
    """The team with one constraint relaxed by `amount`."""
    f, member = team.slots[knob.constraint].tolist()
    families = list(team.families)
    family = families[f]
    if knob.parameter:
        changed = family.parameters[knob.parameter].copy()
        changed[(member, *knob.entry)] += knob.sign * amount
        families[f] = dataclasses.replace(family, parameters={**family.parameters, knob.parameter: changed})
    else:
        here = np.arange(family.size) == member
        single, others = family.members(here), family.members(~here)
        slack = {**single.parameters, "slack": np.full(1, amount)}
        slackened = dataclasses.replace(single, psi=_Slackened(family.psi), parameters=slack, sources=None)
        families[f : f + 1] = [slackened, others] if others.size else [slackened]
    return team.with_constraints(families, team.owner, team.names)


def restricted(team: Team, keep: Bools) -> Team:
    """The team with only the constraints of an (M,) mask."""
    place = np.cumsum(keep) - 1
    families = []
    for family in team.families:
        members = keep[family.number]
        if members.any():
            kept = family.members(members)
            families.append(dataclasses.replace(kept, number=place[kept.number].astype(np.int32)))
    names = [team.names[k] for k in np.flatnonzero(keep).tolist()]
    return team.with_constraints(families, team.owner[keep], names)


def _proposal(team: Team, knob: _Knob, amount: float) -> str:
    label = _label(team, knob.constraint)
    if not knob.parameter:
        return f"Letting ψ of {label} fall short of 0 by {_number(amount)} would do."
    verb = "Raising" if knob.sign > 0 else "Lowering"
    what = knob.parameter if not knob.entry else f"{knob.parameter}[{knob.entry[0]}]"
    after = knob.now + knob.sign * amount
    digits = 4 if not after else max(4, math.ceil(math.log10(abs(after) / amount)) + DIGITS)
    return f"{verb} the {what} of {label} by {_number(amount)}, from {_number(knob.now, digits)} to {_number(after, digits)}, would do."


def _listed(team: Team, constraints: list[int]) -> str:
    labels = [_label(team, k) for k in constraints[:NAMED]]
    if len(constraints) > NAMED:
        labels.append(f"{len(constraints) - NAMED} more")
    return " and ".join([", ".join(labels[:-1]), labels[-1]]) if len(labels) > 1 else "".join(labels)


def _label(team: Team, constraint: int) -> str:
    """Label of a constraint: ``a2's tether to a3``, or ``a2's near(a3)`` if the name already contains the other agents."""
    owner, name = int(team.owner[constraint]), team.names[constraint]
    f, member = team.slots[constraint].tolist()
    family = team.families[f]
    others = [team.ids[i] for i in family.agents[member].tolist() if i != owner]
    to = f" to {', '.join(others)}" if others and not name.startswith(f"{family.kind}(") else ""
    return f"{team.ids[owner]}'s {name}{to}"


def _number(value: float, digits: int = 4) -> str:
    return f"{value:.{digits}g}".replace("-", "−")
