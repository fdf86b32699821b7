"""Live terminal dashboard: one row per agent with its state, margin, rate and links."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Final

import numpy as np

from consat.network.deploy.observer import AgentRecord, Observer
from consat.network.node.modes import REPORT

if TYPE_CHECKING:
    from rich.table import Table

_KNOWN: Final = {
    "satisfied": ", all know that all are satisfied",
    "infeasible": ", all know that not all can be satisfied",
}


@contextmanager
def board(title: str, *, quiet: bool) -> Iterator[Callable[[Observer, Mapping[str, bool], float], None]]:
    """Context manager for a live table on stderr; it draws nothing if `quiet` or if stderr is not a terminal.

    Args:
        title: title of the table.
        quiet: whether to draw nothing.

    Yields:
        a function that redraws the table from the observer, whether each agent's process runs, and the time since the start, s.
    """
    if quiet or not sys.stderr.isatty():
        yield lambda *_: None
        return
    from rich.console import Console
    from rich.live import Live

    with Live(console=Console(stderr=True), refresh_per_second=8, transient=True) as live:
        yield lambda observer, running, seconds: live.update(table(title, observer, running, seconds))


def table(title: str, observer: Observer, running: Mapping[str, bool], seconds: float) -> Table:
    """The table, as a rich renderable.

    Args:
        title: title of the table.
        observer: what the agents have reported.
        running: whether the process of each agent runs, by id.
        seconds: time since the start, s.
    """
    from rich.table import Table
    from rich.text import Text

    margins = [record.report["margin"] for record in observer.records.values() if record.report and record.report["margin"] is not None]
    worst = f", margin {min(margins):+.4g}" if margins else ""
    known = _KNOWN.get(observer.all_known()[0] or "", "")
    drawn = Table(title=f"{title}: {seconds:.1f} s{worst}{known}", title_justify="left")
    for column in ("agent", "state", "margin", "turns/s", "loss", "round trip", "deaf to"):
        drawn.add_column(column, justify="left" if column in ("agent", "state", "deaf to") else "right")
    for agent, record in observer.records.items():
        up = running.get(agent, False)
        peers = record.report["peers"] if record.report else {}
        margin = record.report["margin"] if record.report else None
        loss = [peer["loss"] for peer in peers.values()]
        trips = [peer["trip"] for peer in peers.values() if peer["trip"] is not None]
        drawn.add_row(
            agent,
            Text(_state(record, up=up), style="" if up else "bold red"),
            "" if margin is None else Text(f"{margin:+.4g}", style="green" if margin > 0 else "red"),
            f"{_rate(record):.0f}",
            f"{np.mean(loss):.0%}" if loss else "",
            f"{1e3 * np.mean(trips):.1f} ms" if trips else "",
            Text(" ".join(other for other, peer in peers.items() if not peer["up"]), style="red"),
        )
    return drawn


def _state(record: AgentRecord, *, up: bool) -> str:
    if not up:
        return "ended" if record.ended is not None else "down"
    if record.report is None:
        return "starting"
    return record.known or ("running" if record.stamps else "waiting")


def _rate(record: AgentRecord) -> float:
    """Turns per second in the last report."""
    return len(record.report["track"]) / REPORT if record.report else 0.0
