"""Figures of a run, as in the paper: formation, margins, estimates, integral states."""

from __future__ import annotations

import logging
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from consat.results.result import Result
from consat.views.colours import COLOURS, GREY, STYLES, colour
from consat.views.record import evenly, period, recorded, seconds
from consat.views.scene import Scene
from consat.views.words import label, plain, typeset

if TYPE_CHECKING:
    import xarray as xr

VERDICTS: Mapping[str, Mapping[str, Any]] = {
    "feasible": {"facecolor": "#009E73", "edgecolor": "#009E73"},
    "infeasible": {"facecolor": "#D55E00", "edgecolor": "white", "hatch": "xxx"},
    "undecided": {"facecolor": "0.85", "edgecolor": "0.45", "hatch": "..."},
}
"""Style of each verdict over time. The hatches differ as well as the colours."""
DPI = 150
MOST_CURVES, MOST_ENTRIES, MOST_DOTS = 120, 12, 60
MOST_HELD = 12
"""Most agents for which every copy is drawn as a curve. With more agents, or more than `MOST_CURVES` curves, quantile bands are drawn."""


def formation(result: Result, axes: Any = None) -> Figure | None:
    """Figure of the formation: paths from start (open marker) to end (filled marker), and the region of each constraint at the end.

    Args:
        result: result of a run.
        axes: matplotlib axes to draw on, 3-D axes for a team in space; None for a new figure.

    Returns:
        the figure; None if no positions were recorded.
    """
    if "position" not in result.data:
        return None
    scene = Scene(result, axes)  # the figure is the last moment of the film
    scene.show(scene.last)
    figure: Figure = scene.figure
    return figure


def margins(result: Result) -> Figure:
    """Figure of the margin β̄ over time or rounds.

    It also shows the time from which on every constraint holds, and the proven interval of the best margin. The second curve is the upper
    bound that all agents have proven, if the protocol gives one; else the smooth margin β.
    """
    data, summary = recorded(result), result.summary
    figure, axes, clock = _chart(result, "margin of the team", "margin", timed=True)
    along = seconds(result, data[str(data["margin"].dims[0])].values.astype(float)) if clock == "time" else data[clock].values
    axes.axhline(0.0, color="black", linewidth=0.8)
    proves = "bound" in data and np.isfinite(data["bound"].values).any()
    curves = [("margin", r"margin $\barβ$", 0), *([] if proves else [("smooth_margin", r"smooth margin $β$", 1)])]
    for name, text, k in curves:
        curve = data[name].where(np.isfinite(data[name]))
        dots = "." if clock == "round" and len(curve) <= MOST_DOTS else ""
        axes.plot(along, curve, color=COLOURS[k], linestyle=STYLES[k], linewidth=1.8, marker=dots, label=text)
    if proves:
        bound = data["bound"].where(np.isfinite(data["bound"]))
        axes.plot(along, bound, color=COLOURS[1], linestyle=(0, (1, 1)), linewidth=2.2, label="bound that all agents have proven")
    axes.margins(y=0.08)
    _stretch(axes, *(data[name].values for name, *_ in curves))
    verdicts = summary.get("verdicts")
    lower, upper = (summary.get("bounds") or (None, None)) if not verdicts else (None, None)  # of moving constraints: the end only
    if lower is not None and upper is not None:
        proven = typeset(lower) if typeset(lower) == typeset(upper) else f"{typeset(lower)} to {typeset(upper)}"
        axes.axhspan(lower, upper, color=COLOURS[2], alpha=0.25, label=f"best possible margin, proven: {proven}")
    since = summary["satisfied_from"]["time" if clock == "time" else "round"]
    if since is not None:
        axes.axvline(since, color=COLOURS[3], linewidth=1.5, linestyle=":")
        text = f"satisfied from t = {typeset(since)} s" if clock == "time" else f"satisfied from round {since:.0f}"
        late = since > np.mean(axes.get_xlim())
        axes.text(since, 0.06, f" {text} ", ha="right" if late else "left", transform=axes.get_xaxis_transform())
    entries = [*axes.get_legend_handles_labels()[0], *(_band(axes, verdicts) if verdicts else ())]
    figure.legend(handles=entries, loc="outside lower center", ncols=2, frameon=False)
    return figure


def _chart(result: Result, title: str, ylabel: str, *, timed: bool = False) -> tuple[Figure, Axes, str]:
    """A figure, its axes, and their horizontal unit, ``time`` or ``round``. `timed`: use time if the rounds have a duration."""
    figure = Figure(figsize=(8.4, 4.8), layout="constrained")
    axes = figure.add_subplot(title=f"{plain(result.summary['scenario'])}: {title}", ylabel=ylabel)
    clock = str(result.data["margin"].dims[0])
    first, last = result.data[clock].values[[0, -1]].astype(float)
    if timed and period(result) is not None:
        clock, (first, last) = "time", seconds(result, np.array([first, last]))
    axes.set(xlabel="time t [s]" if clock == "time" else "round", xlim=(first, last if last > first else first + 1))
    axes.locator_params("x", integer=clock == "round")
    axes.grid(color="0.92", linewidth=0.8)
    axes.spines[["top", "right"]].set_visible(False)
    return figure, axes, clock


def _band(axes: Axes, verdicts: Sequence[Mapping[str, Any]]) -> list[Patch]:
    """Draw verdicts over time as a band below a chart, labelled where there is room. Returns the legend entries."""
    band = axes.inset_axes((0.0, -0.26, 1.0, 0.07), sharex=axes)
    first, last = axes.get_xlim()
    for each in verdicts:
        verdict, start, stop = str(each["verdict"]), float(each["from"]), float(each["to"])
        band.axvspan(start, stop, **VERDICTS[verdict], linewidth=0, gid=f"verdict {verdict}")
        if stop - start > 0.014 * len(verdict) * (last - first):
            around = {"facecolor": "white", "linewidth": 0, "pad": 1.5}
            band.text((start + stop) / 2, 0.48, verdict, ha="center", va="center", fontsize=8, bbox=around)
    band.set(yticks=[], xlim=(first, last), ylim=(0, 1))
    band.tick_params(bottom=False, labelbottom=False)
    seen = {str(each["verdict"]) for each in verdicts}
    return [Patch(**look, linewidth=0, label=f"the constraints: {verdict}") for verdict, look in VERDICTS.items() if verdict in seen]


def _stretch(axes: Axes, *curves: np.ndarray) -> None:
    """If the curves begin much larger than they end, set a vertical scale that shows both: linear around zero, logarithmic beyond."""
    finite = [np.abs(curve[np.isfinite(curve)]) for curve in curves]
    largest = max((float(curve.max()) for curve in finite if len(curve)), default=0.0)
    end = max((float(curve[-1]) for curve in finite if len(curve)), default=0.0)
    if largest <= 10 * end or not largest:
        return
    decade = math.floor(math.log10(1.2 * max(end, 1e-4 * largest)))
    axes.set_yscale("asinh", linear_width=10.0**decade / 3)
    limits = axes.get_ylim()
    decades = 10.0 ** np.arange(decade, math.ceil(math.log10(largest)) + 1)
    axes.set_yticks([*-decades[::-1], 0.0, *decades], minor=False)
    axes.set_yticks(np.outer([*-decades, *decades], range(2, 10)).ravel(), minor=True)
    axes.yaxis.set_major_formatter(lambda value, _: f"{value:g}".replace("-", "−"))
    axes.set_ylim(limits)


def estimates(result: Result) -> Figure | None:
    """Figure of the agents' estimates of positions: one colour per coordinate, one line style per holder.

    For many copies, quantile bands of the estimation error. None if the estimates were not recorded.
    """
    unit = None if result.team is None else result.team.unit
    return _copies(result, "estimate", "estimates of the positions", label("estimate", unit))


def integrals(result: Result) -> Figure | None:
    """Figure of the integral states, drawn as the estimates. For many copies, bands of their norms. None if they were not recorded."""
    return _copies(result, "integral", "integral states", "integral state z")


def _copies(result: Result, name: str, title: str, ylabel: str) -> Figure | None:
    data = recorded(result)
    if name not in data:
        return None
    ids = [str(value) for value in data["agent"].values] if "agent" in data.coords else []
    curves = data[name].shape[1] * data[name].shape[2]
    if len(ids) > MOST_HELD or curves > MOST_CURVES or not {str(value) for value in data["held"].values} <= set(ids):
        return _spread(result, data, name, title)
    names = [str(value) for value in data["axis"].values]
    index = {agent: i for i, agent in enumerate(ids)}
    count, dimension = data[name].shape[1:]
    shades = _shades(len(ids), dimension)
    figure, axes, clock = _chart(result, title, ylabel)
    for copy in range(count):
        holder, held = (index[str(data[key].values[copy])] for key in ("holder", "held"))
        for values, shade in zip(data[name].values[:, copy].T, shades[held], strict=True):
            axes.plot(data[clock], values, color=shade, linestyle=STYLES[holder % len(STYLES)], linewidth=1.3)
    entries = [
        Line2D([], [], color=shades[i, k], linewidth=2.5, label=f"{names[k]} of {plain(ids[i], 14)}")
        for i, k in (divmod(place, dimension) for place in evenly(len(ids) * dimension, MOST_ENTRIES))
    ]
    for agent, style in zip(ids, STYLES, strict=False):
        entries.append(Line2D([], [], color=GREY, linestyle=style, label=f"held by {plain(agent, 14)}"))
    if len(ids) > len(STYLES):
        entries.append(Line2D([], [], linestyle="", label="… and so on, in turn"))
    axes.legend(handles=entries, loc="upper left", bbox_to_anchor=(1.01, 1.0), frameon=False, borderaxespad=0)
    return figure


def _spread(result: Result, data: xr.Dataset, name: str, title: str) -> Figure:
    """Quantile bands over all copies: of their norms or, for estimates, of the estimation errors."""
    values, what, unit = data[name].values, f"size of the {title}", None
    ids = {str(agent): i for i, agent in enumerate(data["agent"].values)} if "agent" in data.coords else {}
    known = [copy for copy, held in enumerate(data["held"].values) if str(held) in ids]
    if name == "estimate" and known:
        team = result.team
        what, unit = "distance of the estimate from the position", None if team is None else team.unit
        place = [ids[str(data["held"].values[copy])] for copy in known]
        of_others = data["holder"].values != data["held"].values  # an agent knows its own position: no error
        others = [j for j, copy in enumerate(known) if of_others[copy]]
        values = (values[:, known] - data["position"].values[:, place])[:, others or slice(None)]
    sizes = np.linalg.norm(values, axis=2)
    count = sizes.shape[1]
    figure, axes, clock = _chart(result, f"{title}, {count:,} copies", label(what, unit))
    low, first, middle, third, high = np.quantile(np.nan_to_num(sizes, nan=0.0, posinf=0.0), [0.0, 0.25, 0.5, 0.75, 1.0], axis=1)
    floor = 1e-3 * float(middle.max(initial=0.0)) or 1e-12
    axes.fill_between(data[clock], low, high, color=COLOURS[0], alpha=0.13, linewidth=0, label="all copies")
    axes.fill_between(data[clock], first, third, color=COLOURS[0], alpha=0.35, linewidth=0, label="the middle half")
    axes.plot(data[clock], middle, color=COLOURS[0], linewidth=1.8, label="median")
    axes.plot(data[clock], high, color=COLOURS[1], linewidth=1.0, linestyle="--", label="largest")
    if high.max() > 100 * max(high[-1], floor):
        axes.set_yscale("symlog", linthresh=floor)
    axes.set_ylim(bottom=0.0)
    figure.legend(loc="outside lower center", ncols=4, frameon=False)
    return figure


def _shades(agents: int, dimension: int) -> np.ndarray:
    """(N, d, 3) a colour for each coordinate: shades of the agent's colour; for many agents, colours of one colour map."""
    if agents > len(COLOURS):
        return mpl.colormaps["viridis"](np.linspace(0, 0.95, agents * dimension))[:, :3].reshape(agents, dimension, 3)
    base = np.array([to_rgb(colour(i)) for i in range(agents)])[:, None]
    white = np.resize([0.0, 0.5, -0.5, 0.75, -0.75], dimension)[:, None]  # negative: black
    return (1 - np.abs(white)) * base + np.maximum(white, 0.0)


def save(result: Result, directory: str | os.PathLike[str]) -> list[Path]:
    """Write formation.png, margins.png and, if recorded, estimates.png and integrals.png into a directory. Returns the paths."""
    target = Path(directory)
    target.mkdir(parents=True, exist_ok=True)
    paths = []
    for name, figure in _all(result):
        paths.append(target / f"{name}.png")
        figure.savefig(paths[-1], dpi=DPI)
    return paths


def show(result: Result) -> list[Path]:
    """Show the figures in windows, or in the notebook, and wait until they are closed. The list of files is empty."""
    from matplotlib import pyplot
    from matplotlib.backends.registry import BackendFilter, backend_registry

    if mpl.get_backend().lower() in backend_registry.list_builtin(BackendFilter.NON_INTERACTIVE):
        logging.getLogger(__name__).warning("there is no display to show figures on; result.plot('figures') writes them into a directory")
        return []
    for _, figure in _all(result):
        pyplot.figure(figure)
    pyplot.show()
    return []


def _all(result: Result) -> Iterator[tuple[str, Figure]]:
    for draw in (formation, margins, estimates, integrals):
        figure = draw(result)
        if figure is not None:
            yield draw.__name__, figure
