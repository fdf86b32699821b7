"""What commands print and how they end: exit codes, results, progress, messages."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import click

from consat.errors import InvalidInput

if TYPE_CHECKING:
    from consat.results.result import Result
    from consat.scenario import Scenario

DONE, FAILED, USAGE, INVALID, UNSATISFIED, INTERRUPTED = 0, 1, 2, 3, 4, 130
PATIENCE = 2000
"""Default limit of a run, in rounds or in seconds of a flow."""


@contextmanager
def located(scenario: Scenario | None) -> Iterator[None]:
    """Add the location in the scenario file to faults that are found after parsing, such as a cluster without links."""
    from consat.scenario import located as in_file

    try:
        yield
    except InvalidInput as error:
        raise error if scenario is None else in_file(error, scenario) from None


def tell(result: Result, *, quiet: bool, as_json: bool) -> int:
    """Print a result. Returns the exit code."""
    if as_json:
        click.echo(json.dumps(result.summary))
    elif not quiet:
        click.echo(str(result))
    if result.summary["ending"] == "interrupted":
        return INTERRUPTED
    return {"satisfied": DONE, "diverged": FAILED}.get(result.summary["status"], UNSATISFIED)


@contextmanager
def progress(quiet: bool, total: float | None = None, *, share: bool = False) -> Iterator[Callable[[float, float | None], None]]:
    """Progress bar on stderr, if that is a terminal. Yields a function of the fraction done and the margin.

    Args:
        quiet: whether to show nothing.
        total: number of rounds, or seconds of a flow, for the displayed rate; `PATIENCE` if None.
        share: whether the second argument is the fraction of satisfied runs instead of the margin.
    """
    if quiet or not sys.stderr.isatty():
        yield lambda *_: None
        return
    import time

    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    columns = BarColumn(), TextColumn("{task.percentage:>3.0f} %"), TimeElapsedColumn(), TextColumn("{task.fields[said]}")
    with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("run", total=1.0, said="compiling …")
        first: list[tuple[float, float]] = []

        def update(done: float, margin: float | None) -> None:
            first.append((time.perf_counter(), done)) if not first else None
            since, before = first[0]
            per_second = (done - before) * (total or PATIENCE) / max(time.perf_counter() - since, 1e-9)
            rate = f"{per_second:,.0f}/s   " if margin is not None and done > before else ""
            said = "" if margin is None else f"{margin:.0%} satisfied" if share else f"{rate}margin {margin:+.4g}"
            bar.update(task, completed=done, said=said)

        yield update


def show_rich(parts: Iterable[Any]) -> None:
    """Print rich text on stdout; with a fixed width of 160 characters if stdout is not a terminal."""
    from rich.console import Console

    console = Console() if sys.stdout.isatty() else Console(width=160)
    for part in parts:
        console.print(part, highlight=False, soft_wrap=isinstance(part, str))


def say(text: str) -> None:
    """Print a message on stderr."""
    click.echo(text, err=True)
