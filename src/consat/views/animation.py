"""The formation in motion, as an animated GIF."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
from matplotlib.artist import Artist
from matplotlib.backends.backend_agg import FigureCanvasAgg
from PIL import Image

from consat.errors import InvalidSettings
from consat.results.result import Result
from consat.views.scene import Scene, moments

MOVEMENT = 0.75  # share of a film that goes by the way travelled, the rest by the clock: most happens in the first seconds


def save(
    result: Result, path: str | os.PathLike[str], seconds: float = 8.0, fps: int = 15, *, progress: Callable[[float], None] | None = None
) -> Path:
    """Write the formation in motion as an animated GIF.

    Args:
        result: of a run.
        path: must end in ``.gif``.
        seconds: how long the film lasts, s; 10 % of it shows the end.
        fps: frames a second.
        progress: called with the share that is done, 0 to 1.

    Raises:
        InvalidSettings: another ending.
    """
    target = Path(path)
    if target.suffix.lower() != ".gif":
        raise InvalidSettings(f"the animation is an animated GIF, but {target} doesn't end in .gif; write {target.with_suffix('.gif')}")
    target.parent.mkdir(parents=True, exist_ok=True)
    scene = Scene(result)
    scene.figure.set_dpi(90)
    canvas = FigureCanvasAgg(scene.figure)
    scene.show(scene.last)
    canvas.draw()  # lays everything out, for good
    scene.figure.set_layout_engine("none")
    scene.axes.set_title("")
    for artist in scene.moving:
        artist.set_visible(False)
    canvas.draw()
    background = canvas.copy_from_bbox(scene.figure.bbox)
    count = max(2, round(seconds * fps))
    moving = moments(scene, count - count // 10, MOVEMENT if scene.x.shape[2] > 1 else 0.0)
    frames = []
    for k, moment in enumerate(np.pad(moving, (0, count // 10), "edge")):
        scene.show(moment)
        if scene.x.shape[2] == 3:
            canvas.draw()
        else:
            canvas.restore_region(background)
            for artist in sorted([*scene.moving, scene.axes.title], key=Artist.get_zorder):
                scene.axes.draw_artist(artist)
        frames.append(Image.fromarray(np.asarray(canvas.buffer_rgba())).convert("RGB"))
        if progress is not None:
            progress((k + 1) / count)
    palette = frames[-1].quantize(256)
    palette.putpalette([255 if level > 245 else level for level in palette.getpalette() or ()])  # white stays white
    first, *others = (frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames)
    ends = np.round(np.arange(count + 1) * 100 / fps)  # a GIF counts in 10 ms
    first.save(target, save_all=True, append_images=others, duration=(10 * np.diff(ends)).astype(int).tolist(), loop=0)
    return target
