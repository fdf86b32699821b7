"""Figure of a sweep: time to satisfaction, last margin and success rate over a parameter, with the spread over the seeds."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, PercentFormatter

from consat.errors import counted
from consat.views.colours import COLOURS, GREY, MARKERS, STYLES
from consat.views.figures import DPI
from consat.views.words import plain

MOST_LINES, MOST_BANDS = 6, 3
"""Most values of the other parameters that have a line, and most lines whose spread is a band; with more lines it is bars."""
LOGARITHMIC = 30.0
"""The axis of a parameter is logarithmic if its values span more than this factor, in nearly constant ratios."""


def save(summary: Mapping[str, Any], runs: Sequence[Mapping[str, Any]], path: str | os.PathLike[str]) -> Path:
    """Draw a sweep.

    Args:
        summary: summary of the sweep (schema consat.sweep/1).
        runs: rows of the sweep, one per run.
        path: PNG file to write.

    Returns:
        the path of the file.
    """
    target = Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    draw(summary, runs).savefig(target, dpi=DPI)
    return target


def draw(summary: Mapping[str, Any], runs: Sequence[Mapping[str, Any]]) -> Figure:
    """The figure that `save` writes; arguments as there."""
    figure = Figure(figsize=(8.4, 8.2), layout="constrained")
    if summary["over"]:
        _over(figure, summary)
    else:
        _seeds(figure, summary, runs)
    return figure


def _title(summary: Mapping[str, Any]) -> str:
    seeds = counted(summary["groups"][0]["runs"], "seed")
    return f"{plain(summary['scenario'])}: {summary['protocol']}, {summary['estimates']} estimates, {seeds}"


def _unit(summary: Mapping[str, Any]) -> str:
    flows = summary["groups"][0]["messages"] is None
    return "time to satisfaction [s]" if flows else "rounds to satisfaction"


def _over(figure: Figure, summary: Mapping[str, Any]) -> None:
    """Draw three panels over the parameter with the most values, with a line for each combination of values of the others."""
    over: Mapping[str, Sequence[Any]] = summary["over"]
    along = max(over, key=lambda path: len(over[path]))
    others = [path for path in over if path != along]
    axes = figure.subplots(3, 1, sharex=True, height_ratios=[3, 3, 1.4])
    places, labels, numeric = _places(over[along])
    ratios = numeric and _even_ratios(places)
    lines = list({tuple(map(str, (group["values"][path] for path in others))): None for group in summary["groups"]})
    drawn = lines[:MOST_LINES]
    bands, handles = len(drawn) <= MOST_BANDS, []
    for k, line in enumerate(drawn):
        groups = [group for group in summary["groups"] if tuple(str(group["values"][path]) for path in others) == line]
        colour, style = COLOURS[k % len(COLOURS)], STYLES[k % len(STYLES)]
        look: dict[str, Any] = {"color": colour, "linestyle": style, "marker": MARKERS[k % len(MARKERS)], "markersize": 5, "linewidth": 1.8}
        aside = 0.0 if bands or len(places) < 2 else (k / (len(drawn) - 1) - 0.5) * 0.3
        at = (
            places * np.exp(aside * np.log(places[1] / places[0])) if ratios else places + aside * np.diff(np.sort(places)).min(initial=1.0)
        )
        for panel, name in zip(axes, ("satisfied_from", "margin"), strict=False):
            middle, low, high = (
                np.array([np.nan if g[name] is None else g[name][key] for g in groups]) for key in ("median", "10 %", "90 %")
            )
            if bands:
                panel.fill_between(at, low, high, color=colour, alpha=0.16, linewidth=0)
            else:
                panel.vlines(at, low, high, color=colour, linewidth=1.2, alpha=0.7)
            curve = panel.plot(at, middle, label=", ".join(plain(value, 16) for value in line), **look)
        axes[2].plot(at, [g["success"] for g in groups], **look)
        handles += curve
    _dress(axes, summary)
    if not numeric:
        axes[2].set_xticks(places, labels)
    elif ratios:
        axes[2].set_xscale("log")
    axes[2].set_xlabel(plain(along, 60))
    notes = f"line: median over the seeds; {'band' if bands else 'bar'}: from the 10th to the 90th percentile"
    notes += f"; {len(lines) - MOST_LINES} more in the table" if len(lines) > MOST_LINES else ""
    axes[0].set_title(f"{_title(summary)}\n", fontsize=12)
    axes[0].text(0.5, 1.02, notes, transform=axes[0].transAxes, ha="center", va="bottom", fontsize=9, color=GREY)
    if others:
        title = ", ".join(plain(path, 50) for path in others)
        figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False, title=title)


def _dress(axes: Sequence[Axes], summary: Mapping[str, Any]) -> None:
    for panel, label in zip(axes, (_unit(summary), r"last margin $\barβ$", "satisfied"), strict=True):
        panel.set_ylabel(label)
        panel.grid(color="0.92", linewidth=0.8)
        panel.set_axisbelow(True)
        panel.spines[["top", "right"]].set_visible(False)
    axes[0].yaxis.set_major_locator(MaxNLocator(integer=summary["groups"][0]["messages"] is not None))
    low, high = axes[1].get_ylim()
    if low <= 0 <= high:
        axes[1].axhline(0.0, color="black", linewidth=0.8)
    axes[2].set_ylim(-0.05, 1.05)
    axes[2].yaxis.set_major_formatter(PercentFormatter(1.0))


def _places(values: Sequence[Any]) -> tuple[np.ndarray, list[str], bool]:
    """Positions of a parameter's values on the axis, their labels, and whether they are numbers."""
    numeric = all(isinstance(value, int | float) and not isinstance(value, bool) for value in values)
    places = np.array(values, dtype=float) if numeric else np.arange(len(values), dtype=float)
    return places, [plain(str(value), 16) for value in values], numeric


def _even_ratios(places: np.ndarray) -> bool:
    return bool(
        len(places) > 2 and (places > 0).all() and places.max() / places.min() > LOGARITHMIC and np.ptp(np.diff(np.log(places))) < 1.0
    )


def _seeds(figure: Figure, summary: Mapping[str, Any], runs: Sequence[Mapping[str, Any]]) -> None:
    """Draw histograms over the seeds, for a sweep without parameters."""
    figure.set_size_inches(8.4, 6.2)
    panels = figure.subplots(2, 1)
    [group] = summary["groups"]
    whole = group["messages"] is not None
    for panel, name, label in zip(panels, ("satisfied_from", "margin"), (_unit(summary), r"last margin $\barβ$"), strict=True):
        rounds = whole and name == "satisfied_from"
        found = np.array([run[name] for run in runs if run[name] is not None], dtype=float)
        panel.set(xlabel=label, ylabel="runs")
        panel.grid(axis="y", color="0.92", linewidth=0.8)
        panel.set_axisbelow(True)
        panel.spines[["top", "right"]].set_visible(False)
        if not len(found):
            panel.text(0.5, 0.5, "no run got there", transform=panel.transAxes, ha="center", color=GREY)
            continue
        bins = np.arange(found.min() - 0.5, found.max() + 1.5) if rounds and np.ptp(found) < 60 else 40
        panel.hist(found, bins=bins, color=COLOURS[0], edgecolor="white", linewidth=0.5, rwidth=0.9 if rounds else 1.0)
        median = float(np.median(found))
        panel.axvline(median, color=COLOURS[1], linewidth=1.8)
        panel.text(median, 1.0, f" median {median:.3g}", transform=panel.get_xaxis_transform(), va="bottom", ha="center", color=COLOURS[1])
    if whole:
        panels[0].xaxis.set_major_locator(MaxNLocator(integer=True))
    panels[0].set_title(f"{_title(summary)}: {group['success']:.1%} satisfied\n", fontsize=12)
