"""Film of the formation: an animated GIF or an MP4 video."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from fractions import Fraction
from importlib.util import find_spec
from pathlib import Path
from typing import Final

import numpy as np
from matplotlib.artist import Artist
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import Collection
from PIL import Image

from consat.errors import InvalidSettings
from consat.results.result import Result
from consat.views.scene import Scene

MOVEMENT: Final = 0.75
"""Weight of the distance travelled in the time scale of a film; the rest is the clock. Most motion is in the first seconds of a run."""
STEP: Final = 0.5
"""Longest time that a film spends on one recorded step, if there are enough of them, s."""
LAST: Final = 1.0
"""Longest time that a film shows the final formation, s."""
FINE: Final = 121
"""Grid points per axis of the view at which ψ is evaluated in a film."""
FORMATS: Final = (".gif", ".mp4")
SAMPLES: Final = 24
"""Frames from which the colours of a GIF are chosen."""


def save(
    result: Result, path: str | os.PathLike[str], seconds: float = 8.0, fps: int = 10, *, progress: Callable[[float], None] | None = None
) -> Path:
    """Write a film of the formation.

    Args:
        result: result of a run with recorded positions.
        path: file to write. It ends in ``.gif``, or in ``.mp4``, which needs PyAV (``consat[video]``).
        seconds: length of the film, s. The end, 10 % but at most `LAST`, shows the final formation.
        fps: frames per second.
        progress: called after each frame with the fraction that is done, 0 to 1.

    Returns:
        the path of the file.

    Raises:
        InvalidSettings: the path has another ending, no positions were recorded, or PyAV is not installed.
    """
    target = Path(path)
    suffix = target.suffix.lower()
    if suffix not in FORMATS:
        raise InvalidSettings(f"a film ends in {' or '.join(FORMATS)}, but {target} doesn't; write {target.with_suffix('.gif')}")
    if "position" not in result.data:
        raise InvalidSettings("nobody's positions were recorded, so there is nothing to show; run with --record all")
    if suffix == ".mp4" and find_spec("av") is None:
        raise InvalidSettings("an MP4 needs PyAV; install it with: pip install 'consat[video]' (a GIF needs nothing)")
    target.parent.mkdir(parents=True, exist_ok=True)
    count = max(2, round(seconds * fps))
    shown = frames(result, count, fps, progress)
    if suffix == ".mp4":
        _mp4(target, shown, fps)
    else:
        _gif(target, list(shown), fps)
    return target


def frames(result: Result, count: int, fps: int, progress: Callable[[float], None] | None = None) -> Iterator[np.ndarray]:
    """Yield `count` frames of a film, (height, width, 3) uint8. The static background is drawn once; arguments as in `save`."""
    scene = Scene(result, fine=FINE)
    scene.figure.set_dpi(90)
    canvas = FigureCanvasAgg(scene.figure)
    scene.show(scene.last)
    canvas.draw()  # computes the layout, which all frames share
    scene.figure.set_layout_engine("none")
    scene.axes.set_title("")
    for artist in scene.moving:
        artist.set_visible(False)
    canvas.draw()
    background = canvas.copy_from_bbox(scene.figure.bbox)
    for artist in scene.moving:
        artist.set_visible(True)
    held = min(count // 10, round(LAST * fps))
    moving = scene.record.moments(count - held, MOVEMENT if scene.x.shape[2] > 1 else 0.0, STEP * fps / count)
    for k, moment in enumerate(np.pad(moving, (0, held), "edge")):
        if k < len(moving):
            scene.show(moment)
            canvas.restore_region(background)
            for artist in sorted([*scene.moving, scene.axes.title], key=Artist.get_zorder):
                if isinstance(artist, Collection) and scene.x.shape[2] == 3:
                    artist.do_3d_projection()  # type: ignore[attr-defined]
                scene.axes.draw_artist(artist)
            picture = np.array(canvas.buffer_rgba())[:, :, :3]
        yield picture
        if progress is not None:
            progress((k + 1) / count)


def _gif(target: Path, shown: Sequence[np.ndarray], fps: int) -> None:
    """Write a GIF with one palette for all frames. A table maps the top five bits of each channel to an index of the palette."""
    some = [shown[k] for k in np.unique(np.linspace(0, len(shown) - 1, SAMPLES).astype(int))]
    palette = Image.fromarray(np.concatenate([each[::2, ::2] for each in some])).quantize(255)
    colours = np.array(palette.getpalette(), dtype=np.uint8).reshape(-1, 3)[:255]
    colours[colours.min(axis=1) > 245] = 255  # white stays white
    palette.putpalette(colours.tobytes())
    bits = np.arange(32, dtype=np.uint8) * 8
    every = np.stack(np.meshgrid(bits, bits, bits, indexing="ij"), axis=-1).reshape(1, -1, 3)
    every = np.where(every == 248, 255, every + 4 * (every > 0))
    table = np.asarray(Image.fromarray(every.astype(np.uint8)).quantize(palette=palette, dither=Image.Dither.NONE)).ravel()
    pictures = []
    for frame in shown:
        short = frame.astype(np.uint16) >> 3
        picture = Image.fromarray(table[short[..., 0] << 10 | short[..., 1] << 5 | short[..., 2]], "P")
        picture.putpalette(colours.tobytes())
        pictures.append(picture)
    ends = np.round(np.arange(len(shown) + 1) * 100 / fps)  # durations in a GIF are multiples of 10 ms
    durations = (10 * np.diff(ends)).astype(int).tolist()
    pictures[0].save(target, save_all=True, append_images=pictures[1:], duration=durations, loop=0)


def _mp4(target: Path, shown: Iterator[np.ndarray], fps: int) -> None:
    """Write H.264, which every browser and player supports."""
    import av

    with av.open(str(target), "w") as film:
        stream = None
        for picture in shown:
            height, width = (side - side % 2 for side in picture.shape[:2])  # the format requires an even width and height
            if stream is None:
                stream = film.add_stream("libx264", rate=Fraction(fps), options={"crf": "18"})
                stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture[:height, :width]), format="rgb24")
            film.mux(stream.encode(frame))
        if stream is not None:
            film.mux(stream.encode())
