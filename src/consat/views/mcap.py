"""Export of a run to an MCAP file, which Foxglove and other robotics tools open.

Topics, all in the frame ``world``: ``/agents`` foxglove.PointCloud with the fields x, y, z, margin; ``/tf`` a frame for each agent;
``/scene`` foxglove.SceneUpdate with regions, keep-outs, links, names, robots and obstacles; ``/margin`` the margin of the team, to plot;
``/agent_margins`` the margin of each agent. ``/tf`` and ``/agent_margins`` are left out for large teams.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from matplotlib.colors import to_rgb

from consat.errors import InvalidSettings
from consat.results.result import Result
from consat.robots.obstacles import Box, Disc, Obstacle
from consat.views import bodies, space
from consat.views.colours import LINK, SHARED, colour, colour_of
from consat.views.picture import FEW
from consat.views.record import Record, period
from consat.views.regions import MOST, outlines, view
from consat.views.shapes import Balls, Shapes, Walls, boxes, moves, shapes

if TYPE_CHECKING:
    from foxglove.messages import Color, SceneEntity

    from consat.problem.team import Team

WORLD: Final = "world"
ROUND: Final = 0.1
"""Duration of a round in the file, s, for runs whose clock is rounds."""
MOST_NAMED, MOST_SHAPES, MOST_NUMBERS = 200, 2_000, 10_000_000
THIN: Final = 0.02
"""Height of discs in the plane, relative to their radius."""


def save(result: Result, path: str | os.PathLike[str]) -> Path:
    """Write the file.

    Args:
        result: result of a run with recorded positions.
        path: file to write; ends in ``.mcap``.

    Returns:
        the path of the file.

    Raises:
        InvalidSettings: foxglove-sdk is not installed.
    """
    try:
        import foxglove
        from foxglove import channels, messages
    except ImportError:
        raise InvalidSettings("an MCAP file needs foxglove-sdk; install it with: pip install 'consat[mcap]'") from None

    target, record, summary = Path(path), Record(result), result.summary
    data = record.data
    clock = str(data["position"].dims[0])
    x = _in_space(np.nan_to_num(record.x))
    team = None if "final_position" in result.data else result.team
    steps = data[clock].values.astype(float)
    times = record.times if record.clock == "time" else steps * ROUND
    ids = [str(name) for name in data["agent"].values]
    margins, margin, smooth = (data[name].values for name in ("agent_margin", "margin", "smooth_margin"))
    context = foxglove.Context()
    pace = "" if clock == "time" else str(period(result) or ROUND)
    about = {"scenario": str(summary["scenario"]), "clock": clock, "seconds_per_round": pace}
    with foxglove.open_mcap(target, allow_overwrite=True, context=context) as writer:
        writer.write_metadata(
            "consat", {**about, "status": summary["status"], "verdict": summary["verdict"], "version": summary["version"]}
        )
        points = channels.PointCloudChannel("/agents", context=context)
        frames = channels.FrameTransformsChannel("/tf", context=context)
        pictures = channels.SceneUpdateChannel("/scene", context=context)
        number = foxglove.Channel("/margin", schema=_schema(["margin", "smooth_margin", "step"]), message_encoding="json", context=context)
        each = foxglove.Channel("/agent_margins", schema=_schema(ids), message_encoding="json", context=context)
        scene = _Scene(team, ids, x, record.times, int(result.data["position"].shape[2]))
        robots = _Robots(result, data)
        for k, time in enumerate(times):
            stamp = messages.Timestamp(sec=int(time), nsec=round((time - int(time)) * 1e9) % 1_000_000_000)
            nanoseconds = round(time * 1e9)
            points.log(_cloud(x[k], margins[k], stamp), log_time=nanoseconds)
            if len(ids) <= MOST_NAMED:
                frames.log(_frames(ids, x[k], robots.headings(k, len(ids)), stamp), log_time=nanoseconds)
                told = {name: float(value) for name, value in zip(ids, margins[k], strict=True) if np.isfinite(value)}
                each.log(told, log_time=nanoseconds)
            entities = [*scene.entities(k, stamp), *robots.entities(k, x[k], stamp)]
            pictures.log(messages.SceneUpdate(entities=entities), log_time=nanoseconds)
            numbers = {"margin": _plain(margin[k]), "smooth_margin": _plain(smooth[k]), "step": float(steps[k])}
            number.log(numbers, log_time=nanoseconds)
    return target


def _plain(value: Any) -> float | None:
    return float(value) if np.isfinite(value) else None


def _schema(names: list[str]) -> dict[str, Any]:
    return {"type": "object", "properties": {name: {"type": "number"} for name in names[: 3 * MOST_NAMED]}}


def _in_space(x: np.ndarray) -> np.ndarray:
    """Points (…, d) with exactly three coordinates: the first three, or padded with zeros."""
    missing = max(0, 3 - x.shape[-1])
    return np.concatenate([x[..., :3], np.zeros((*x.shape[:-1], missing))], axis=-1)


def _cloud(x: np.ndarray, margins: np.ndarray, stamp: Any) -> Any:
    from foxglove import messages

    number = messages.PackedElementFieldNumericType.Float32
    fields = [messages.PackedElementField(name=name, offset=4 * k, type=number) for k, name in enumerate(("x", "y", "z", "margin"))]
    packed = np.concatenate([x, np.where(np.isfinite(margins), margins, 0.0)[:, None]], axis=1).astype("<f4")
    pose = messages.Pose(position=messages.Vector3(), orientation=messages.Quaternion(w=1.0))
    return messages.PointCloud(timestamp=stamp, frame_id=WORLD, pose=pose, point_stride=16, fields=fields, data=packed.tobytes())


def _frames(ids: list[str], x: np.ndarray, headings: np.ndarray, stamp: Any) -> Any:
    from foxglove import messages

    return messages.FrameTransforms(
        transforms=[
            messages.FrameTransform(
                timestamp=stamp,
                parent_frame_id=WORLD,
                child_frame_id=name,
                translation=_vector(place),
                rotation=messages.Quaternion(z=math.sin(heading / 2), w=math.cos(heading / 2)),
            )
            for name, place, heading in zip(ids, x, headings.tolist(), strict=True)
        ]
    )


def _vector(place: np.ndarray) -> Any:
    from foxglove import messages

    return messages.Vector3(x=float(place[0]), y=float(place[1]), z=float(place[2]))


class _Scene:
    """Entities of ``/scene``: regions, links and names. Entities that don't move are written once, at the first step."""

    def __init__(self, team: Team | None, ids: list[str], x: np.ndarray, times: np.ndarray, dimension: int) -> None:
        self._times = times
        self._team, self._ids, self._x, self._flat = team, ids, x, dimension < 3
        self._shapes: Shapes | None = None
        self._traced: list[int] = []
        if team is not None and len(team.owner) <= 10 * MOST_SHAPES and dimension <= 3:
            self._shapes = shapes(team)
            others = self._shapes.others.tolist()
            self._traced = others if dimension == 2 and len(others) <= MOST else []
            axes = slice(0, dimension)
            around = np.concatenate([boxes(team)[:, :, axes], np.stack([x[-1].min(axis=0), x[-1].max(axis=0)])[None, :, axes]])
            self._low, self._high, _ = view(x[:, :, axes], x[-1, :, axes], None, around)
            self._moves = moves(team)

    def entities(self, k: int, stamp: Any) -> Iterator[SceneEntity]:
        """The entities to write at step k."""
        x = self._x[k]
        if self._shapes is not None and self._team is not None:
            time = float(self._times[k])
            found = shapes(self._team, time) if self._team.moves else self._shapes
            yield from self._balls(found.balls, k, x, stamp)
            yield from self._outlines(k, x, stamp)
            yield from self._walls(found.walls, k, stamp)
            if len(self._team.links):
                lines = _line(x[self._team.links].reshape(-1, 3), LINK, 1.0, pairs=True)
                yield _entity("links", stamp, lines=[lines])
        if len(self._ids) <= MOST_NAMED:
            yield _entity("names", stamp, texts=[_text(name, place) for name, place in zip(self._ids, x, strict=True)])

    def _balls(self, balls: Balls, k: int, x: np.ndarray, stamp: Any) -> Iterator[SceneEntity]:
        chosen = np.flatnonzero(balls.around < 0) if len(balls.radius) > MOST_NAMED else np.arange(len(balls.radius))
        centers = _in_space(balls.at(x[:, : balls.center.shape[1]]))
        for j in chosen[:MOST_SHAPES].tolist():
            if k and not balls.moves[j]:
                continue
            out, radius = bool(balls.keeps_out[j]), float(balls.radius[j])
            shade = _colour(SHARED if out else colour_of(balls.owners[j]), 0.7 if out else 0.12)
            name = f"{'keep-out' if out else 'region'} {balls.numbers[j][0]}"
            height = None if not self._flat else (4 if out else 1) * THIN
            body = _round(centers[j, None], balls.radius[j, None], [shade], height)
            angle = np.linspace(0, 2 * np.pi, 65)[:, None]
            ring = centers[j] + radius * np.concatenate([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
            yield _entity(name, stamp, lines=[_line(ring, SHARED if out else colour_of(balls.owners[j]), 2.0)], **body)

    def _walls(self, walls: Walls, k: int, stamp: Any) -> Iterator[SceneEntity]:
        if walls.normal.shape[1] == 1:
            return
        found = dict(space.faces(walls, self._low, self._high))
        for j, (number, *_) in enumerate(walls.numbers):
            if k and not self._moves[number]:
                continue
            corners = found.get(j, np.zeros((0, walls.normal.shape[1])))  # none where it is out of view
            closed = corners if len(corners) <= 2 else np.concatenate([corners, corners[:1]])
            yield _entity(f"wall {number}", stamp, lines=[_line(_in_space(closed), colour_of(walls.owners[j]), 2.0)])

    def _outlines(self, k: int, x: np.ndarray, stamp: Any) -> Iterator[SceneEntity]:
        if self._team is None:
            return
        asked = [number for number in self._traced if k == 0 or self._moves[number]]
        if not asked:
            return
        now = self._team.at(float(self._times[k]))
        for number, found in zip(asked, outlines(now, asked, x[:, :2], self._low, self._high), strict=True):
            shade = colour_of((int(self._team.owner[number]),))
            yield _entity(f"region {number}", stamp, lines=[_line(_in_space(line), shade, 2.0) for line in found])


class _Robots:
    """Entities of ``/scene`` for robots: their bodies, the strokes of their headings, and the obstacles.

    Args:
        result: result of the run.
        data: its recorded agents and steps.
    """

    def __init__(self, result: Result, data: Any) -> None:
        self._found, self._map = bodies.bodies(result, data), bodies.obstacles(result)
        self._flat = data.sizes["axis"] < 3

    def headings(self, k: int, count: int) -> np.ndarray:
        """(N,) headings at step k, rad; zero without headings."""
        heading = None if self._found is None else self._found.heading
        return np.zeros(count) if heading is None else np.nan_to_num(heading[k])

    def entities(self, k: int, x: np.ndarray, stamp: Any) -> Iterator[SceneEntity]:
        """The entities to write at step k, with the agents at x (N, 3). Obstacles are written once."""
        if k == 0:
            for number, each in enumerate(self._map):
                yield _entity(f"obstacle {number}", stamp, **self._obstacle(each))
        found = self._found
        if found is None or len(x) > MOST_SHAPES:
            return
        ahead = found.ahead(k)
        middle, lines = found.middle(x, ahead), []
        if ahead is not None and found.turns.any():
            strokes = np.stack([middle, middle + found.radius[:, None] * _in_space(ahead)], axis=1)
            strokes[:, :, 2] += 0.55 * found.radius[:, None]  # above the body
            lines = [_line(strokes[found.turns].reshape(-1, 3), bodies.EDGE, 2.0, pairs=True)]
        shades = [_colour(colour(i) if len(x) <= FEW else bodies.SOLID, 0.9) for i in range(len(x))]
        yield _entity("bodies", stamp, lines=lines, **_round(middle, found.radius, shades, 1.0 if self._flat else None))

    def _obstacle(self, each: Obstacle) -> dict[str, Any]:
        from foxglove import messages

        shade = _colour(bodies.SOLID, 0.9)
        if isinstance(each, Disc):
            return _round(_in_space(np.array([each.center])), np.array([each.radius]), [shade], 0.1 if self._flat else None)
        if isinstance(each, Box):
            low, high = (_in_space(np.array(corner)) for corner in (each.low, each.high))
            if self._flat:
                high[2] = 0.1 * float((high - low)[:2].min())
            pose = messages.Pose(position=_vector((low + high) / 2), orientation=messages.Quaternion(w=1.0))
            return {"cubes": [messages.CubePrimitive(pose=pose, size=_vector(high - low), color=shade)]}
        corners = _in_space(np.array(bodies.outline(each).vertices))
        return {"lines": [_line(corners, bodies.EDGE, 3.0)]}


def _entity(name: str, stamp: Any, **parts: Any) -> SceneEntity:
    from foxglove.messages import SceneEntity

    return SceneEntity(timestamp=stamp, frame_id=WORLD, id=name, **parts)


def _round(centers: np.ndarray, radii: np.ndarray, shades: Sequence[Color], height: float | None) -> dict[str, list[Any]]:
    """Balls in space; or, with a height relative to the radius, discs of the plane. centers: (K, 3); radii: (K,)."""
    from foxglove import messages

    cylinders, spheres = [], []
    for center, radius, shade in zip(centers, radii.tolist(), shades, strict=True):
        pose = messages.Pose(position=_vector(center), orientation=messages.Quaternion(w=1.0))
        if height is None:
            spheres.append(messages.SpherePrimitive(pose=pose, size=_vector(np.full(3, 2 * radius)), color=shade))
        else:
            size = _vector(radius * np.array([2, 2, height]))
            cylinders.append(messages.CylinderPrimitive(pose=pose, size=size, bottom_scale=1.0, top_scale=1.0, color=shade))
    return {"cylinders": cylinders, "spheres": spheres}


def _line(points: np.ndarray, shade: str, thickness: float, *, pairs: bool = False) -> Any:
    from foxglove import messages

    kind = messages.LinePrimitiveLineType.LineList if pairs else messages.LinePrimitiveLineType.LineStrip
    places = [messages.Point3(x=px, y=py, z=pz) for px, py, pz in points.tolist()]
    pose = messages.Pose(position=messages.Vector3(), orientation=messages.Quaternion(w=1.0))
    return messages.LinePrimitive(type=kind, pose=pose, thickness=thickness, scale_invariant=True, points=places, color=_colour(shade, 0.9))


def _text(name: str, place: np.ndarray) -> Any:
    from foxglove import messages

    pose = messages.Pose(position=_vector(place), orientation=messages.Quaternion(w=1.0))
    shade = _colour("0.1", 1.0)
    return messages.TextPrimitive(pose=pose, billboard=True, font_size=14.0, scale_invariant=True, color=shade, text=name)


def _colour(shade: str, alpha: float) -> Color:
    from foxglove.messages import Color

    red, green, blue = to_rgb(shade)
    return Color(r=red, g=green, b=blue, a=alpha)
