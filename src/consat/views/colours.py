"""Colours, markers and line styles that colour-blind readers can tell apart, and a colour scale for margins."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, Literal

import numpy as np
from matplotlib import colormaps
from matplotlib.colors import BoundaryNorm, Colormap, ListedColormap

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
"""Colours of Okabe and Ito, which colour-blind readers can tell apart. Their yellow is left out: it is hard to see on white."""
MARKERS = ("o", "s", "^", "D", "v", "<", ">")
STYLES: Sequence[Any] = ("-", (0, (5, 2.5)), (0, (1, 2)), (0, (6, 2, 1, 2)), (0, (6, 2, 1, 2, 1, 2)), (0, (10, 4)))
GREY = "0.45"
FEW: Final = 12
"""Most agents that have colours of their own. The pages' script has the same number."""
LINK: Final = "#4d5663"
"""Colour of links: dark. They differ from paths in lightness, so that every reader can tell them apart."""
TRAIL: Final = "#dccaa4"
"""Colour of the paths of many agents: light."""
AREA: Final = (0.0, 0.447, 0.698)
SHARED: Final = "0.3"
"""Colour of regions that several agents share."""
CLASSES: Final = 4
"""Number of margin classes on each side of zero. Each class holds about the same number of agents."""


def colour(agent: int) -> str:
    """Colour of an agent (index in the team), the same in every figure."""
    return COLOURS[agent % len(COLOURS)]


def marker(agent: int) -> str:
    """Marker of an agent (index in the team). Agents with the same colour have different markers."""
    return MARKERS[(agent + agent // len(COLOURS)) % len(MARKERS)]


def colour_of(owners: Sequence[int]) -> str:
    """Colour of a region: that of its owner; `SHARED` for several owners."""
    return colour(owners[0]) if len(owners) == 1 else SHARED


def classes(margins: np.ndarray) -> tuple[Colormap, BoundaryNorm, np.ndarray, Literal["neither", "min", "max"]]:
    """Colour scale for margins by quantiles. Outliers don't compress the rest of the scale.

    Args:
        margins: (N,) margins of the agents. Values that are not finite are ignored.

    Returns:
        the colour map (reds for violated, blues for satisfied, grey where not finite), the norm, the class edges, with zero among them,
        and the argument `extend` of the colour bar: the side without agents, if one sign does not occur.
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
    """The value rounded to two significant digits, away from zero."""
    if value == 0:
        return 0.0
    digit = 10.0 ** (np.floor(np.log10(abs(value))) - 1)
    return float(np.sign(value) * np.ceil(abs(value) / digit - 1e-9) * digit)
