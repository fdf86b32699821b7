"""Colours that the colour-blind can tell apart: of lines, of regions, and a scale of margins."""

from __future__ import annotations

from typing import Any, Final, Literal

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import BoundaryNorm, Colormap, ListedColormap

LINK: Final = "#4d5663"
"""Links are dark and thin, …"""
TRAIL: Final = "#dccaa4"
"""… paths of a crowd light and broad: they differ in lightness, whatever colours a reader sees."""
AREA: Final = (0.0, 0.447, 0.698)
CLASSES: Final = 4
"""Of margins on either side of zero: each holds as many agents."""


def classes(margins: np.ndarray) -> tuple[Colormap, BoundaryNorm, np.ndarray, Literal["neither", "min", "max"]]:
    """A scale for margins whose steps each hold as many agents, so that it is used as a whole, whatever outliers there are.

    Args:
        margins: (N,); those that are not finite count for nothing.

    Returns:
        colours (reds for violated, blues for satisfied, grey for none), the norm, the edges of the steps, zero among them, and on which
        side a colour bar needs an end of the sign that nobody has.
    """
    finite = margins[np.isfinite(margins)]
    bad, good = finite[finite <= 0], finite[finite > 0]
    share = np.linspace(0, 1, CLASSES + 1)
    below = np.quantile(bad, share)[:-1] if len(bad) else np.zeros(0)
    above = np.quantile(good, share)[1:] if len(good) else np.zeros(0)
    edges = np.unique([_short(edge) for edge in (*below, 0.0, *above)])
    if len(edges) < 2:
        edges = np.array([0.0, 1.0])
    reds, blues = int(np.count_nonzero(edges < 0)), int(np.count_nonzero(edges > 0))
    red = np.linspace(0.04, 0.36, reds) if reds > 1 else np.full(reds, 0.12)
    blue = np.linspace(0.64, 0.96, blues) if blues > 1 else np.full(blues, 0.85)
    shades = colormaps["RdBu"](np.concatenate([red, blue]))
    under, over = red[0] if reds else 0.12, blue[-1] if blues else 0.85
    ends: dict[str, Any] = {"under": colormaps["RdBu"](under), "over": colormaps["RdBu"](over), "bad": "0.8"}
    palette: Colormap = ListedColormap(shades).with_extremes(**ends)
    return palette, BoundaryNorm(edges, len(shades)), edges, "min" if not reds else "max" if not blues else "neither"


def _short(value: float) -> float:
    """With two digits, away from zero."""
    if value == 0:
        return 0.0
    digit = 10.0 ** (np.floor(np.log10(abs(value))) - 1)
    return float(np.sign(value) * np.ceil(abs(value) / digit - 1e-9) * digit)
