"""Binary format of a round: a header of 16 bytes, then float32 numbers; all little-endian.

The header: kind, always 1 (uint8); dimensions drawn (uint8); 1 if headings follow, else 0 (uint16); round modulo 2³² (uint32); margin of
the team (float32); number of the scene that lists the agents (uint32). Then N × d positions, N margins, and N headings, rad, if any.
"""

from __future__ import annotations

import struct
from typing import Final

import numpy as np

HEADER: Final = struct.Struct("<BBHIfI")
KIND: Final = 1


def packed(scene: int, round_: int, margin: float, positions: np.ndarray, margins: np.ndarray, headings: np.ndarray | None = None) -> bytes:
    """The bytes of a frame.

    Args:
        scene: number of the scene.
        round_: number of rounds so far.
        margin: margin of the team.
        positions: (N, d) positions. At most the first three dimensions are sent.
        margins: (N,) margins of the agents.
        headings: (N,) headings, rad; None if there are none.
    """
    x = positions[:, :3]
    parts = [x, margins] if headings is None else [x, margins, headings]
    with np.errstate(over="ignore"):
        body = b"".join(np.ascontiguousarray(part, dtype="<f4").tobytes() for part in parts)
    margin = float(np.clip(margin, -3e38, 3e38)) if np.isfinite(margin) else margin
    return HEADER.pack(KIND, x.shape[1], headings is not None, round_ % 2**32, margin, scene) + body
