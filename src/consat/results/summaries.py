"""Typed dictionaries of the summaries that ``run --json`` and ``sweep --json`` print."""

from __future__ import annotations

from typing import Any, Literal, NotRequired, TypedDict

from consat.settings import Layout

Verdict = Literal["feasible", "infeasible", "undecided"]


class SatisfiedFrom(TypedDict):
    """The first step after the last step with a margin ≤ 0, as a time in s and as a round; None if there is none."""

    time: float | None
    round: float | None


class ConstraintSummary(TypedDict):
    """One constraint at the end of a run."""

    name: str
    margin: float | None
    multiplier: float | None
    violated_share: NotRequired[float | None]


class AgentSummary(TypedDict):
    """One agent at the end of a run. The margin is None if it has no constraints."""

    margin: float | None
    constraints: list[ConstraintSummary]


class RunSummary(TypedDict):
    """The output of ``consat run --json`` (schema consat.run/1)."""

    schema: Literal["consat.run/1"]
    scenario: str
    version: str
    protocol: str
    estimates: Layout
    seed: int
    status: Literal["satisfied", "least-violating", "not-converged", "diverged"]
    verdict: Verdict
    margin: float | None
    smooth_margin: float | None
    bounds: list[float | None]
    satisfied_from: SatisfiedFrom
    known: NotRequired[Literal["satisfied", "infeasible"] | None]
    known_from: NotRequired[float | None]
    rounds: int | None
    time: NotRequired[float | None]
    ending: str
    messages: int | None
    floats_sent: int | None
    positions: dict[str, list[float | None]] | None
    agents: dict[str, AgentSummary] | None
    clusters: NotRequired[list[list[str]] | None]
    on_the_way: NotRequired[dict[str, Any] | None]
    count: int
    warnings: NotRequired[list[str]]
    result: NotRequired[str | None]
    seconds: NotRequired[dict[str, float]]
    route: NotRequired[str | None]
    motion: NotRequired[dict[str, Any] | None]
    verdicts: NotRequired[list[dict[str, Any]] | None]
    robots: NotRequired[dict[str, Any] | None]
    obstacles: NotRequired[list[dict[str, Any]] | None]
    restarts: NotRequired[dict[str, Any] | None]


class SweepSummary(TypedDict):
    """The output of ``consat sweep --json`` (schema consat.sweep/1)."""

    schema: Literal["consat.sweep/1"]
    scenario: str
    protocol: str
    estimates: Layout
    over: dict[str, list[Any]]
    seeds: list[int]
    count: int
    seconds: float
    groups: list[dict[str, Any]]
    runs: NotRequired[list[dict[str, Any]] | None]
