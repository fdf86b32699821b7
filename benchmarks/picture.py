"""Rounds to satisfaction against the size of the team, as a picture."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np

mpl.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.lines import Line2D

FAMILIES = {"chain": ("chains", "#0072B2", "o", -0.03), "grid": ("grids", "#D55E00", "s", 0.0), "tree": ("trees", "#009E73", "^", 0.03)}
"""Name, a colour that colour-blind people can tell from the others (Okabe, Ito), marker, and a shift along x so that bars don't hide each other."""
METHODS = {"interior-point": ("-", 1.0), "admm": ("--", 0.0), "flow": (":", 0.0)}
"""Line style, and whether markers are filled."""
TICKS = (1, 3, 10, 30, 100, 300, 1000)


def draw(stages: Any, path: Path) -> None:
    """Args: stages: what was measured; path: of the PNG."""
    figure, axes = plt.subplots(1, 2, figsize=(11, 4.4), sharey=True, layout="constrained")
    for panel, (box, loss) in zip(axes, ((4.0, 0.0), (1e4, 0.3)), strict=True):
        for family in FAMILIES:
            for method in METHODS:
                if loss == 0 or method != "flow":
                    _curve(panel, stages, family, method, box, loss)
        panel.set(xscale="log", yscale="log", xlabel="agents")
        panel.set_xticks([3, 10, 30, 100, 300, 1000], ["3", "10", "30", "100", "300", "1000"])
        panel.minorticks_off()
        panel.grid(color="#e4e4e4", linewidth=0.8)
        panel.set_axisbelow(True)
        panel.spines[["top", "right"]].set_visible(False)
        where = "±4, no loss" if loss == 0 else "±10 000, 30 % of the messages lost"
        panel.set_title(f"from {where}", fontsize=11, loc="left")
    low, high = axes[0].get_ylim()
    axes[0].set_yticks([tick for tick in TICKS if low <= tick <= high], [str(tick) for tick in TICKS if low <= tick <= high])
    axes[0].set_ylim(low, high)
    axes[0].set_ylabel("rounds to satisfaction for good")
    families = [Line2D([], [], color=colour, marker=marker, linestyle="", label=name) for name, colour, marker, _ in FAMILIES.values()]
    methods = [
        Line2D([], [], color="#444444", linestyle=line, marker="o", markerfacecolor="#444444" if filled else "white", label=_name(method))
        for method, (line, filled) in METHODS.items()
    ]
    figure.legend(handles=[*families, *methods], loc="outside right center", frameon=False, fontsize=10)
    figure.savefig(path, dpi=150)
    plt.close(figure)


def _name(method: str) -> str:
    return {"flow": "sampled flow,\nbest step"}.get(method, method)


def _curve(panel: Any, stages: Any, family: str, method: str, box: float, loss: float) -> None:
    _, colour, marker, shift = FAMILIES[family]
    line, filled = METHODS[method]
    points = []
    for stage in stages:
        measured = stage.results.get((method, (box, loss, 0.0)))  # a Condition, with nobody asleep
        if stage.problem.family != family or measured is None:
            continue
        taken = measured.satisfied[np.isfinite(measured.satisfied)]
        if len(taken):
            points.append((stage.problem.count * 10**shift, np.median(taken), taken.min(), taken.max()))
    if not points:
        return
    x, median, low, high = np.array(points).T
    panel.errorbar(
        x, median, [median - low, high - median], color=colour, marker=marker, linestyle=line, linewidth=1.6, markersize=6, elinewidth=1,
        capsize=2.5, markerfacecolor=colour if filled else "white",
    )  # fmt: skip
