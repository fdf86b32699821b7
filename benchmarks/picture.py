"""Rounds to satisfaction against the size of the team, as a picture."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np

mpl.use("Agg")
import matplotlib.pyplot as plt

STYLES = {"chain": ("#0072B2", "o", -0.03), "grid": ("#D55E00", "s", 0.0), "tree": ("#009E73", "^", 0.03)}
"""Colours that colour-blind people can tell apart (Okabe, Ito), marker, and a shift along x so that bars don't hide each other."""
FLOW = {"chain": ("chains", "#0072B2"), "grid": ("grids", "#D55E00"), "tree": ("trees", "#009E73")}


def draw(stages: Any, path: Path) -> None:
    """Args: stages: what was measured; path: of the PNG."""
    figure, axes = plt.subplots(1, 2, figsize=(11, 4.4), sharey=True, layout="constrained")
    for panel, (box, loss) in zip(axes, ((4.0, 0.0), (1e4, 0.3)), strict=True):
        for family, (color, marker, shift) in STYLES.items():
            _curve(panel, stages, family, "admm", box, loss, color=color, marker=marker, shift=shift, line="-", filled=True)
            if loss == 0:
                _curve(panel, stages, family, "flow", box, loss, color=color, marker=marker, shift=shift, line="--", filled=False)
        panel.set(xscale="log", yscale="log", xlabel="agents")
        panel.set_xticks([3, 10, 30, 100, 300, 1000], ["3", "10", "30", "100", "300", "1000"])
        panel.set_yticks([1, 3, 10, 30, 100, 300, 1000, 3000, 10000], ["1", "3", "10", "30", "100", "300", "1000", "3000", "10000"])
        panel.minorticks_off()
        panel.grid(color="#e4e4e4", linewidth=0.8)
        panel.set_axisbelow(True)
        panel.spines[["top", "right"]].set_visible(False)
        where = "±4, no loss" if loss == 0 else "±10 000, 30 % of the messages lost"
        panel.set_title(f"from {where}", fontsize=11, loc="left")
    axes[0].set_ylabel("rounds to satisfaction for good")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right center", frameon=False, fontsize=10)
    figure.savefig(path, dpi=150)
    plt.close(figure)


def _curve(
    panel: Any,
    stages: Any,
    family: str,
    method: str,
    box: float,
    loss: float,
    *,
    color: str,
    marker: str,
    shift: float,
    line: str,
    filled: bool,
) -> None:
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
    name = "sampled flow" if method == "flow" else method
    panel.errorbar(
        x, median, [median - low, high - median], color=color, marker=marker, linestyle=line, linewidth=1.6, markersize=6, elinewidth=1,
        capsize=2.5, markerfacecolor=color if filled else "white", label=f"{FLOW[family][0]}, {name}",
    )  # fmt: skip
