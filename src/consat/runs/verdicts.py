"""Verdicts over time, for a team with moving constraints: certificates of an observer at sampled times.

A verdict is proven at each sampled time. Between two consecutive times with the same verdict the verdict is assumed to hold. Where the
verdicts differ, the time of the change is narrowed down by bisection, and the remaining gap is undecided.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from typing import Any, Literal, NamedTuple

import numpy as np

from consat.certify.certificate import judged
from consat.problem.objective import margins
from consat.problem.team import Team

SAMPLES = 120
"""Largest number of equally spaced intervals at whose ends verdicts are certified; the knots of schedules are added."""
COSTLY = 2000
"""Limit of (number of intervals) × (number of agents): larger teams have fewer intervals, at least 8."""
NARROWED = 6
"""Number of bisections of a gap between two different verdicts."""

Verdict = Literal["feasible", "infeasible", "undecided"]


class Instant(NamedTuple):
    """Certificate at one time.

    Attributes:
        time: s.
        verdict: see `consat.certify.certificate.Certificate`.
        lower: margin of a known formation, a lower bound on the best margin.
        upper: proven upper bound on the best margin; None without one.
    """

    time: float
    verdict: Verdict
    lower: float
    upper: float | None


def verdicts(
    team: Team, duration: float, seen: Callable[[float], np.ndarray | None], *, since: float = 0.0
) -> list[dict[str, Any]]:  # fmt: skip
    """Intervals that cover a run, for ``run --json``. Each has ``from`` and ``to``, s, ``verdict``, and ``bounds`` over the interval.

    Args:
        team: team with moving constraints.
        duration: duration of the run, s.
        seen: returns the positions in the run at about a given time, s, (N, d), as a candidate; None where they are not recorded.
        since: where the intervals begin, s.
    """
    samples = int(np.clip(COSTLY // max(team.count, 1), 8, SAMPLES))
    knots = team.knots[(team.knots > since) & (team.knots < duration)]
    times = np.unique(np.concatenate([np.linspace(since, duration, samples + 1), knots])) if duration > since else np.array([duration])
    found = [certify(team, time, seen(time)) for time in times.tolist()]
    return intervals(_narrowed(team, found, seen))


def certify(team: Team, time: float, x: np.ndarray | None) -> Instant:
    """Certificate at one time.

    Args:
        team: team with moving constraints.
        time: s.
        x: (N, d) candidate positions, or None. If they satisfy every constraint they prove feasibility; else the team is solved centrally.
    """
    here = team.at(time)
    if x is not None and np.isfinite(x).all() and (lower := float(margins(here, x).min(initial=np.inf))) > 0:
        return Instant(time, "feasible", lower, None)
    found = judged(here)[1]
    return Instant(time, found.verdict, found.lower, found.upper)


def _narrowed(team: Team, found: Sequence[Instant], seen: Callable[[float], np.ndarray | None]) -> list[Instant]:
    """Add certificates by bisection between times with different verdicts."""
    whole = [found[0]]
    for before, after in itertools.pairwise(found):
        low, high = before, after
        for _ in range(NARROWED if before.verdict != after.verdict else 0):
            between = certify(team, 0.5 * (low.time + high.time), seen(0.5 * (low.time + high.time)))
            if between.verdict == low.verdict:
                low = between
            elif between.verdict == high.verdict:
                high = between
            else:
                break
        whole += [each for each in (low, high) if each.time > whole[-1].time]
        if whole[-1].time < after.time:
            whole.append(after)
    return whole


def intervals(found: Sequence[Instant]) -> list[dict[str, Any]]:
    """Merge consecutive times with the same verdict into one interval. Gaps between different verdicts become undecided intervals."""
    groups: list[list[Instant]] = [[found[0]]]
    for each in found[1:]:
        if each.verdict == groups[-1][-1].verdict:
            groups[-1].append(each)
        else:
            groups.append([each])
    spans: list[dict[str, Any]] = []
    for k, group in enumerate(groups):
        if k:
            _say(spans, groups[k - 1][-1].time, group[0].time, "undecided", [groups[k - 1][-1], group[0]])
        _say(spans, group[0].time, group[-1].time, group[0].verdict, group)
    return spans


def _say(spans: list[dict[str, Any]], start: float, stop: float, verdict: Verdict, over: Sequence[Instant]) -> None:
    if spans and spans[-1]["verdict"] == verdict:
        spans[-1]["to"] = stop
        return
    uppers = [each.upper for each in over]
    upper = None if any(each is None for each in uppers) else max(each for each in uppers if each is not None)
    lower = min(each.lower for each in over)
    spans.append({"from": start, "to": stop, "verdict": verdict, "bounds": [lower if np.isfinite(lower) else None, upper]})
