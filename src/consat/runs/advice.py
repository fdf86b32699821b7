"""Warnings about a run, as sentences that name a remedy."""

from __future__ import annotations

import numpy as np

from consat.certify.quadratics import Floats, values_and_gradients
from consat.problem.objective import Nu
from consat.problem.team import Team
from consat.problem.units import Scale
from consat.protocols import FLOWS, ROUNDS
from consat.protocols.solver import FLAT
from consat.results.trace import Trace

NAMED = 3
"""Largest number of constraints that a warning names; of further ones it gives the number."""
ROUNDS_HELP = next(iter(ROUNDS))


def warnings_of(team: Team, trace: Trace, nu: Nu, size: Scale, protocol: str) -> list[str]:
    """Warnings about a run; empty without any.

    Args:
        team: the team.
        trace: trace of the run.
        nu: ν at the end of the run.
        size: the team's natural scale.
        protocol: name of the protocol.
    """
    found = []
    if protocol in FLOWS and trace.ending in ("diverged", "too stiff"):
        found.append(_flow(trace, nu))
    if np.isfinite(trace.end).all():
        found += _positions(team, trace.end, nu, size)
    return found


def around_loops(route: str | None, trace: Trace) -> list[str]:
    """Warning about a run over links with loops that ended unsatisfied by its limit of rounds; empty for other runs."""
    if route != "links" or trace.ending != "out of time" or trace.satisfied_from is not None:
        return []
    what = (
        f"What agents tell each other went round loops of links and had not come to rest after {trace.steps[-1]:.0f} rounds: the team may "
        "be torn, or the loops do not converge. What would help: fewer links, so that a spanning tree is narrow enough (consat check says "
        "how narrow that is), or --protocol admm."
    )
    return [what]


def _flow(trace: Trace, nu: Nu) -> str:
    alpha, beta = float(nu.alpha), float(nu.beta)
    went = "diverged" if trace.ending == "diverged" else "became too stiff to follow"
    smaller = f"'smoothing={{nu_alpha: {alpha / 10:.2g}, nu_beta: {beta / 10:.2g}}}'"
    ramp = f"'smoothing={{nu_alpha: {alpha:.3g}, nu_beta: {{from: {beta / 500:.2g}, to: {beta:.3g}, rate: {beta / 227:.2g}}}}}'"
    return (
        f"The flow {went} at t = {trace.steps[-1]:.4g} s: f = exp(-nu psi) is too large there, or bends too much. What would help: a "
        f"smaller nu (--set {smaller}), a ramp of nu_beta (--set {ramp}), or "
        f"a protocol in rounds (--protocol {ROUNDS_HELP}), which takes any start."
    )


def _positions(team: Team, x: Floats, nu: Nu, size: Scale) -> list[str]:
    """Warnings about violated constraints without a usable gradient: ψ = −∞, or ψ flat. `x`: (N, d) final positions."""
    values, gradients = values_and_gradients(team, x)
    margins = np.full(team.count, np.inf)
    np.minimum.at(margins, team.owner, values)
    worst = np.flatnonzero((values <= margins[team.owner]) & (values <= 0))
    if not len(worst):
        return []
    ended = worst[values[worst] == -np.inf]
    flat = worst[
        (values[worst] > -np.inf) & (_slopes(team, values, gradients, margins, nu)[team.owner[worst]] * nu.alpha * size.length < FLAT)
    ]
    start = "(start: of an agent, or --set start.box=[LOW,HIGH])"
    found = []
    if len(ended):
        found.append(
            f"{_named(team, ended)} no finite number at the end, which counts as violated beyond measure. What would help: a start where "
            f"it is one {start}, or another constraint that keeps its agents there."
        )
    if len(flat):
        found.append(
            f"{_named(team, flat)} violated and flat at the end (a plateau): no small move changes it, so that there is nothing to climb. "
            f"What would help: a start nearer to where it holds {start}, or a psi that keeps its slope, such as 4 - norm2(p) in place of "
            "tanh(4 - norm2(p))."
        )
    return found


def _slopes(team: Team, values: Floats, gradients: list[Floats], margins: Floats, nu: Nu) -> Floats:
    """(N,) largest absolute entry of ∇α_i, over all positions that agent i reads; 0 for agents without a violated constraint.

    Args:
        team: the team.
        values: (M,) ψ.
        gradients: for each family ∇ψ, (M_f, arity, d).
        margins: (N,) margin of each agent.
        nu: the smoothing.
    """
    bad = (margins <= 0) & (margins > -np.inf)
    base = np.where(bad, margins, 0.0)[team.owner]
    share = np.where(bad[team.owner], np.exp(np.minimum(-float(nu.alpha) * (values - base), 0.0)), 0.0)
    total = np.bincount(team.owner, share, minlength=team.count)
    share = share / np.where(total > 0, total, 1.0)[team.owner]
    keys, entries = [], []
    for family, gradient in zip(team.families, gradients, strict=True):
        members = bad[family.owner]
        keys.append((family.owner[members, None].astype(np.int64) * team.count + family.agents[members]).ravel())
        weighted = share[family.number][members, None, None] * np.nan_to_num(gradient[members])
        entries.append(weighted.reshape(-1, team.dimension))
    found, place = np.unique(np.concatenate(keys), return_inverse=True)
    added = np.zeros((len(found), team.dimension))
    np.add.at(added, place, np.concatenate(entries))
    slopes = np.zeros(team.count)
    np.maximum.at(slopes, found // team.count, np.abs(added).max(axis=1))
    return slopes


def _named(team: Team, constraints: np.ndarray) -> str:
    """Subject and verb of a sentence about constraints, such as ``psi of a1's tether is``."""
    some = [f"{team.ids[int(team.owner[k])]}'s {team.names[int(k)]}" for k in constraints[:NAMED]]
    more = [] if len(constraints) <= NAMED else [f"{len(constraints) - NAMED} more"]
    listed = [*some, *more]
    whole = listed[0] if len(listed) == 1 else f"{', '.join(listed[:-1])} and {listed[-1]}"
    return f"psi of {whole} {'is' if len(listed) == 1 else 'are'}"
