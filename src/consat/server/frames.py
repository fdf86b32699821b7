"""A round as bytes: a header of 16 and float32 numbers, little-endian.

The header: kind 1 (uint8), dimension drawn (uint8), 1 where headings follow (uint16), round (uint32), margin (float32), number of the scene
that the agents are those of (uint32). Then N × d positions, N margins, and N headings in rad if there are any.
"""

from __future__ import annotations

import struct
from typing import Final

import numpy as np

HEADER: Final = struct.Struct("<BBHIfI")
KIND: Final = 1


def packed(scene: int, round_: int, margin: float, positions: np.ndarray, margins: np.ndarray, headings: np.ndarray | None = None) -> bytes:
    """A frame.

    Args:
        scene: number of the scene.
        round_: rounds so far.
        margin: of the team.
        positions: (N, d); of more than three dimensions the first three.
        margins: (N,).
        headings: (N,) rad, or None.
    """
    x = positions[:, :3]
    turned = 0 if headings is None else 1
    with np.errstate(over="ignore"):
        parts = [x, margins] + ([] if headings is None else [headings])
        body = b"".join(np.ascontiguousarray(part, dtype="<f4").tobytes() for part in parts)
    margin = float(np.clip(margin, -3e38, 3e38)) if np.isfinite(margin) else margin
    return HEADER.pack(KIND, x.shape[1], turned, round_ % 2**32, margin, scene) + body
