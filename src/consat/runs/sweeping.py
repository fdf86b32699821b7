"""`sweep`: runs with many seeds and parameter values, as one vectorised computation for protocols in rounds."""

from __future__ import annotations

import csv
import itertools
import json
import os
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np

from consat import __version__
from consat.certify.certificate import bounds
from consat.engine.batch import Lane, Outcome, like, simulate_batch
from consat.errors import InvalidSettings, shown
from consat.faults import Faults
from consat.numerics import float64, number
from consat.problem.team import Team
from consat.protocols import FLOWS, ROUNDS
from consat.results.summaries import SweepSummary
from consat.runs.options import Options
from consat.runs.preparation import Prepared, scenario_of, settings_of, with_auxiliary
from consat.runs.restarting import case_of
from consat.runs.runner import run
from consat.runs.summary import status_of
from consat.scenario import Scenario, loads
from consat.settings import Layout, Start, Stop

SCHEMA = "consat.sweep/1"
MOST_LISTED = 10_000
"""Largest number of runs that the summary lists; the CSV file always lists all."""
MOST_VALUES = 1_000_000
"""Largest number of values in a range."""
OF_A_RUN = ("loss", "sleep")
"""Parameters of the run, not of the scenario."""
MEASURED = ("satisfied_from", "margin", "smooth_margin", "rounds", "messages", "floats_sent")
"""Quantities reported for each run, and as statistics for each combination of values."""


class Sweep:
    """Result of a sweep.

    Attributes:
        summary: the document that ``consat sweep --json`` prints.
        runs: one row per run: values of the parameters, seed, and result.
    """

    def __init__(self, summary: Mapping[str, Any], runs: Sequence[Mapping[str, Any]]) -> None:
        self.summary = cast(SweepSummary, dict(summary))
        self.runs = list(runs)

    def save(self, directory: str | os.PathLike[str]) -> list[Path]:
        """Write sweep.json, sweep.csv (one line per run) and the figure sweep.png. Returns their paths."""
        target = Path(directory)
        target.mkdir(parents=True, exist_ok=True)
        (target / "sweep.json").write_text(json.dumps(self.summary, indent=1))
        with (target / "sweep.csv").open("w", newline="") as file:
            writer = csv.DictWriter(file, list(self.runs[0]))
            writer.writeheader()
            writer.writerows({key: json.dumps(v) if isinstance(v, list | dict) else v for key, v in each.items()} for each in self.runs)
        return [target / "sweep.json", target / "sweep.csv", self.plot(target / "sweep.png")]

    def plot(self, path: str | os.PathLike[str]) -> Path:
        """Write the figure: rounds to satisfaction, margin and success over the parameter; see `consat.views.sweeps`. Returns its path."""
        from consat.views import sweeps

        return sweeps.save(self.summary, self.runs, path)

    def __str__(self) -> str:
        from consat.views import words

        return words.sweep(self.summary)

    def _repr_html_(self) -> str:
        from consat.views import notebook

        return notebook.sweep(self.summary, self.runs)


def values(text: str) -> list[Any]:
    """Parse a list of values ``v1,v2,…`` or a range ``a:b:n`` (n numbers from a to b). Each value is YAML; commas may occur in brackets.

    Raises:
        InvalidSettings: malformed range.
    """
    from consat.scenario.document import read

    if text.count(":") == 2 and "[" not in text and "{" not in text:
        low, high, count = text.split(":")
        try:
            ends, number = (float(low), float(high)), int(count)
        except ValueError:
            raise InvalidSettings(f"{text!r} is no range; write FROM:TO:COUNT, such as 0.5:2:16") from None
        if not np.isfinite(ends).all() or not 0 < number <= MOST_VALUES:
            raise InvalidSettings(f"{text!r} is no range; FROM and TO must be finite, and COUNT a whole number from 1 to {MOST_VALUES:,}")
        found = np.linspace(*ends, number)
        return [float(f"{value:.12g}") for value in found]
    parts, depth = [""], 0
    for char in text:
        depth += (char in "[{") - (char in "]}")
        if char == "," and not depth:
            parts.append("")
        else:
            parts[-1] += char
    nodes = [read(part, "--over").root for part in parts]
    return [None if node is None else node.plain for node in nodes]


class _Combination(NamedTuple):
    """One combination of parameter values, the prepared team, and (loss, sleep)."""

    chosen: Mapping[str, Any]
    ready: Prepared
    faults: tuple[float, float]


@float64
def sweep(
    team: Team | Scenario | str | os.PathLike[str],
    over: Mapping[str, Sequence[Any]] | None = None,
    *,
    seeds: int | Sequence[int] = 1,
    protocol: str | None = None,
    estimates: Layout | None = None,
    start: tuple[Any, Any] | None = None,
    rounds: int | None = None,
    until: float | None = None,
    stop: Stop | None = None,
    loss: float = 0.0,
    sleep: float = 0.0,
    auxiliary: float | None = None,
    full: bool = False,
    progress: Callable[[float, float], None] = lambda *_: None,
) -> Sweep:
    """Run a scenario with many seeds and every combination of parameter values.

    Protocols in rounds run as one vectorised computation, one run per lane. Every run takes the same rounds as alone: `consat.run` with the
    same seed gives the same result up to rounding. Parameters that change array shapes (``count``) need one computation for each value.
    Flows and teams with moving constraints run one after the other.

    Args:
        team: as in `consat.run`. Parameters of a scenario can be swept only if `team` is one, or can be written as one.
        over: parameter to list of values. A parameter is a dotted path into the scenario, as for ``--set``, or ``loss`` or ``sleep``.
        seeds: number of seeds, counted from the scenario's seed; or a list of seeds.
        protocol: as in `consat.run`.
        estimates: as in `consat.run`.
        start: as in `consat.run`.
        rounds: as in `consat.run`.
        until: as in `consat.run`.
        stop: as in `consat.run`.
        loss: as in `consat.run`.
        sleep: as in `consat.run`.
        auxiliary: as in `consat.run`.
        full: whether to list every run in the summary, also above `MOST_LISTED` runs.
        progress: called with the fraction of runs that have ended, and the fraction of these that satisfied every constraint.

    Raises:
        InvalidSettings: the settings do not fit together, or no values or seeds are given.
    """
    began = time.perf_counter()
    scenario = scenario_of(team)
    over = {} if over is None else {path: list(options) for path, options in over.items()}
    if empty := [path for path, options in over.items() if not options]:
        raise InvalidSettings(f"no values are given for {empty[0]}; give some, such as {empty[0]}=1,2,3")
    asked = _Asked(scenario, Options(
        protocol=protocol, estimates=estimates, start=start, rounds=rounds, until=until, stop=stop, loss=loss, sleep=sleep,
        auxiliary=auxiliary,
    ))  # fmt: skip
    first = scenario.settings.start.seed
    numbers = list(range(first, first + seeds)) if isinstance(seeds, int) else [int(seed) for seed in seeds]
    if not numbers:
        raise InvalidSettings("there are no seeds; give at least one")
    combinations = list(asked.combinations(over))
    kinds = {each.ready.settings.protocol.kind for each in combinations}
    if kinds & FLOWS.keys() or any(each.ready.team.moves for each in combinations):
        rows = list(asked.one_by_one(combinations, numbers, progress))
    else:
        rows = asked.together(combinations, numbers, progress)
    settings = combinations[0].ready.settings
    summary = {
        "schema": SCHEMA,
        "scenario": scenario.name,
        "version": __version__,
        "protocol": "/".join(sorted(map(str, kinds))),
        "estimates": settings.protocol.estimates,
        "seeds": [numbers[0], len(numbers)] if numbers == list(range(numbers[0], numbers[0] + len(numbers))) else numbers,
        "over": over,
        "count": len(rows),
        "groups": [_told({path: each.chosen[path] for path in over}, rows[k * len(numbers) : (k + 1) * len(numbers)])
                   for k, each in enumerate(combinations)],
        "runs": rows if full or len(rows) <= MOST_LISTED else None,
        "seconds": round(time.perf_counter() - began, 4),
    }  # fmt: skip
    return Sweep(summary, rows)


@dataclass(frozen=True)
class _Asked:
    """The scenario and options that all runs share."""

    scenario: Scenario
    options: Options

    def combinations(self, over: Mapping[str, Sequence[Any]]) -> Iterator[_Combination]:
        """All combinations of the values; the last parameter changes fastest."""
        of_scenario = [path for path in over if path not in OF_A_RUN]
        if of_scenario and not self.scenario.text:
            raise InvalidSettings(f"{of_scenario[0]} is a path into a scenario, but this team has none that a file could hold")
        made: dict[str, Prepared] = {}
        for options in itertools.product(*over.values()):
            chosen = dict(zip(over, options, strict=True))
            overrides = [f"{path}={json.dumps(chosen[path])}" for path in of_scenario]
            if (key := json.dumps(overrides)) not in made:
                made[key] = self._prepared(overrides)
            loss, sleep = (_probability(name, chosen.get(name, getattr(self.options, name))) for name in OF_A_RUN)
            yield _Combination(chosen, made[key], (loss, sleep))

    def _prepared(self, overrides: Sequence[str]) -> Prepared:
        scenario = loads(self.scenario.text, self.scenario.source, overrides) if overrides else self.scenario
        if self.options.auxiliary is not None:
            scenario = with_auxiliary(scenario, self.options.auxiliary)
        settings = settings_of(scenario.settings, self.options, scenario.team)
        kind, asked = settings.protocol.kind, self.options
        if (kind in FLOWS and (asked.rounds or asked.loss or asked.sleep)) or (kind in ROUNDS and asked.until and not scenario.team.moves):
            raise InvalidSettings(
                f"protocol {kind} is none to which all of these settings mean anything: until is for flows, the rest for rounds"
            )
        return Prepared.of(scenario.team, settings)

    def together(
        self, combinations: Sequence[_Combination], seeds: Sequence[int], progress: Callable[[float, float], None]
    ) -> list[dict[str, Any]]:
        """Run all combinations in rounds, with one computation for each set of array shapes."""
        batches: dict[Any, list[tuple[int, Lane]]] = defaultdict(list)
        protocols = {}
        for k, combination in enumerate(combinations):
            kind = str(combination.ready.settings.protocol.kind)
            case = case_of(combination.ready, Faults(*combination.faults), self.options)
            key = (kind, like(case))
            protocols[key] = ROUNDS[kind]()
            box = combination.ready.settings.start.box
            for n, seed in enumerate(seeds):
                first = combination.ready.first(Start(box=box, seed=seed))
                batches[key].append((k * len(seeds) + n, Lane(case, first, seed)))
        outcomes: dict[int, Outcome] = {}
        total, ended = len(combinations) * len(seeds), 0
        for key, lanes in batches.items():

            def report(done: float, share: float, before: int = ended, count: int = len(lanes)) -> None:
                progress((before + done * count) / total, share)

            found = simulate_batch(protocols[key], [lane for _, lane in lanes], report)
            outcomes |= {place: outcome for (place, _), outcome in zip(lanes, found, strict=True)}
            ended += len(lanes)
        return [
            {**combination.chosen, "seed": seed, **_row(combination.ready, outcomes[k * len(seeds) + n])}
            for k, combination in enumerate(combinations)
            for n, seed in enumerate(seeds)
        ]

    def one_by_one(
        self, combinations: Sequence[_Combination], seeds: Sequence[int], progress: Callable[[float, float], None]
    ) -> Iterator[dict[str, Any]]:
        """Run all combinations one after the other."""
        satisfied, total = 0, len(combinations) * len(seeds)
        for k, (combination, seed) in enumerate(itertools.product(combinations, seeds)):
            ready, (loss, sleep) = combination.ready, combination.faults
            scenario = Scenario(self.scenario.name, ready.team, ready.settings, "", self.scenario.source)
            result = run(
                scenario,
                seed=seed,
                rounds=self.options.rounds,
                until=self.options.until,
                stop=self.options.stop,
                loss=loss,
                sleep=sleep,
                agents="none",
                record=False,
            )
            summary: Mapping[str, Any] = {**result.summary}
            since = summary["satisfied_from"]["round"] if summary["rounds"] is not None else summary["satisfied_from"]["time"]
            satisfied += summary["status"] == "satisfied"
            progress((k + 1) / total, satisfied / (k + 1))
            measured = {name: since if name == "satisfied_from" else summary[name] for name in MEASURED}
            yield {**combination.chosen, "seed": seed, **{key: summary[key] for key in ("status", "verdict", "ending")}, **measured}


def _probability(name: str, value: Any) -> float:
    """Check a probability. Raises: InvalidSettings: it is not a number in [0, 1)."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value < 1:
        raise InvalidSettings(f"{name} is {shown(value)}, but must be a probability below 1, such as 0.3")
    return float(value)


def _row(ready: Prepared, outcome: Outcome) -> dict[str, Any]:
    """Result of one run, with the keys of ``run --json``."""
    tally, margin = outcome.tally, outcome.tally.margin
    certificate = None if margin > 0 else bounds(ready.team, outcome.positions, ready.schedule.final)
    return {
        "status": status_of(outcome.ending, margin, None if certificate is None else certificate.upper, ready.size.psi),
        "verdict": "feasible" if certificate is None else certificate.verdict,
        "ending": outcome.ending,
        "satisfied_from": tally.last_bad + 1 if tally.last_bad < tally.done else None,
        "margin": number(margin),
        "smooth_margin": number(tally.smooth_margin),
        "rounds": tally.done,
        "messages": tally.messages,
        "floats_sent": tally.floats,
    }


def _told(chosen: Mapping[str, Any], rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Statistics over the runs of one combination."""
    return {
        "values": dict(chosen),
        "runs": len(rows),
        "success": sum(row["status"] == "satisfied" for row in rows) / len(rows),
        **{name: _spread([row[name] for row in rows if row[name] is not None]) for name in MEASURED},
    }


def _spread(found: Sequence[float]) -> dict[str, float] | None:
    """Statistics of a list of numbers; None if it is empty."""
    if not found:
        return None
    low, median, high = np.quantile(found, [0.1, 0.5, 0.9])
    return {"count": len(found), "mean": float(np.mean(found)), "std": float(np.std(found)), "min": float(min(found)), "10 %": float(low),
            "median": float(median), "90 %": float(high), "max": float(max(found))}  # fmt: skip
