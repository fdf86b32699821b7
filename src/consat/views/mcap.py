"""Export of a run to an MCAP file, which Foxglove and other robotics tools open.

Topics, all in the frame ``world``: ``/agents`` foxglove.PointCloud with the fields x, y, z, margin; ``/tf`` a frame for each agent;
``/scene`` foxglove.SceneUpdate with regions, keep-outs, links, names, robots and obstacles; ``/margin`` the margin of the team, to plot;
``/agent_margins`` the margin of each agent. ``/tf`` and ``/agent_margins`` are left out for large teams.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import foxglove
import numpy as np
from foxglove import channels, messages
from foxglove.messages import Color, SceneEntity, Timestamp
from matplotlib.colors import to_rgb

from consat.numerics import number
from consat.results.result import Result
from consat.robots.obstacles import Box, Disc, Obstacle
from consat.views import bodies, space
from consat.views.colours import FEW, LINK, SHARED, colour, colour_of
from consat.views.record import Record, period
from consat.views.regions import MOST_TRACED, outlines, view
from consat.views.shapes import Balls, Shapes, Walls, boxes, moves, shapes

if TYPE_CHECKING:
    from consat.problem.team import Team

WORLD: Final = "world"
ROUND: Final = 0.1
"""Duration of a round in the file, s, for runs whose clock is rounds."""
MOST_NAMED, MOST_SHAPES = 200, 2_000
THIN: Final = 0.02
"""Height of discs in the plane, relative to their radius."""


def save(result: Result, path: Path) -> None:
    """Write the file.

    Args:
        result: result of a run with recorded positions.
        path: file to write; ends in ``.mcap``.
    """
    record, summary = Record(result), result.summary
    data = record.data
    clock = str(data["position"].dims[0])
    x = _in_space(np.nan_to_num(record.x))
    steps = data[clock].values.astype(float)
    times = record.times if record.clock == "time" else steps * ROUND
    ids = record.ids
    margins, margin, smooth = (data[name].values for name in ("agent_margin", "margin", "smooth_margin"))
    context = foxglove.Context()
    pace = "" if clock == "time" else str(period(result) or ROUND)
    about = {"scenario": str(summary["scenario"]), "clock": clock, "seconds_per_round": pace}
    with foxglove.open_mcap(path, allow_overwrite=True, context=context) as writer:
        writer.write_metadata(
            "consat", {**about, "status": summary["status"], "verdict": summary["verdict"], "version": summary["version"]}
        )
        points = channels.PointCloudChannel("/agents", context=context)
        frames = channels.FrameTransformsChannel("/tf", context=context)
        pictures = channels.SceneUpdateChannel("/scene", context=context)
        numbers = foxglove.Channel("/margin", schema=_schema(["margin", "smooth_margin", "step"]), message_encoding="json", context=context)
        each = foxglove.Channel("/agent_margins", schema=_schema(ids), message_encoding="json", context=context)
        scene = _Scene(record.team, ids, x, record.times, int(result.data["position"].shape[2]))
        robots = _Robots(result, data)
        for k, time in enumerate(times):
            stamp = messages.Timestamp(sec=int(time), nsec=round((time - int(time)) * 1e9) % 1_000_000_000)
            nanoseconds = round(time * 1e9)
            points.log(_cloud(x[k], margins[k], stamp), log_time=nanoseconds)
            if len(ids) <= MOST_NAMED:
                frames.log(_frames(ids, x[k], robots.headings(k, len(ids)), stamp), log_time=nanoseconds)
                finite = {name: float(value) for name, value in zip(ids, margins[k], strict=True) if np.isfinite(value)}
                each.log(finite, log_time=nanoseconds)
            entities = [*scene.entities(k, stamp), *robots.entities(k, x[k], stamp)]
            pictures.log(messages.SceneUpdate(entities=entities), log_time=nanoseconds)
            row = {"margin": number(margin[k]), "smooth_margin": number(smooth[k]), "step": float(steps[k])}
            numbers.log(row, log_time=nanoseconds)


def _schema(names: list[str]) -> dict[str, Any]:
    return {"type": "object", "properties": {name: {"type": "number"} for name in names[: 3 * MOST_NAMED]}}


def _in_space(x: np.ndarray) -> np.ndarray:
    """Points (…, d) with exactly three coordinates: the first three, or padded with zeros."""
    return np.pad(x[..., :3], [*[(0, 0)] * (x.ndim - 1), (0, max(0, 3 - x.shape[-1]))])


def _cloud(x: np.ndarray, margins: np.ndarray, stamp: Timestamp) -> Any:
    kind = messages.PackedElementFieldNumericType.Float32
    fields = [messages.PackedElementField(name=name, offset=4 * k, type=kind) for k, name in enumerate(("x", "y", "z", "margin"))]
    packed = np.concatenate([x, np.where(np.isfinite(margins), margins, 0.0)[:, None]], axis=1).astype("<f4")
    return messages.PointCloud(
        timestamp=stamp, frame_id=WORLD, pose=_pose(np.zeros(3)), point_stride=16, fields=fields, data=packed.tobytes()
    )


def _frames(ids: list[str], x: np.ndarray, headings: np.ndarray, stamp: Timestamp) -> Any:
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
    return messages.Vector3(x=float(place[0]), y=float(place[1]), z=float(place[2]))


def _pose(place: np.ndarray) -> Any:
    return messages.Pose(position=_vector(place), orientation=messages.Quaternion(w=1.0))


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
            self._traced = others if dimension == 2 and len(others) <= MOST_TRACED else []
            axes = slice(0, dimension)
            around = np.concatenate([boxes(team)[:, :, axes], np.stack([x[-1].min(axis=0), x[-1].max(axis=0)])[None, :, axes]])
            self._low, self._high, _ = view(x[:, :, axes], x[-1, :, axes], None, around)
            self._moves = moves(team)

    def entities(self, k: int, stamp: Timestamp) -> Iterator[SceneEntity]:
        """The entities to write at step k."""
        x = self._x[k]
        if self._shapes is not None and self._team is not None:
            time = float(self._times[k])
            found = shapes(self._team, time) if self._team.moves else self._shapes
            yield from self._balls(found.balls, k, x, stamp)
            yield from self._outlines(self._team.at(time), k, x, stamp)
            yield from self._walls(found.walls, k, stamp)
            if len(self._team.links):
                lines = _line(x[self._team.links].reshape(-1, 3), LINK, 1.0, pairs=True)
                yield _entity("links", stamp, lines=[lines])
        if len(self._ids) <= MOST_NAMED:
            yield _entity("names", stamp, texts=[_text(name, place) for name, place in zip(self._ids, x, strict=True)])

    def _balls(self, balls: Balls, k: int, x: np.ndarray, stamp: Timestamp) -> Iterator[SceneEntity]:
        chosen = np.flatnonzero(balls.around < 0) if len(balls.radius) > MOST_NAMED else np.arange(len(balls.radius))
        centers = _in_space(balls.at(x[:, : balls.center.shape[1]]))
        for j in chosen[:MOST_SHAPES].tolist():
            if k and not balls.moves[j]:
                continue
            out, radius = bool(balls.keeps_out[j]), float(balls.radius[j])
            shade = SHARED if out else colour_of(balls.owners[j])
            name = f"{'keep-out' if out else 'region'} {balls.numbers[j][0]}"
            height = None if not self._flat else (4 if out else 1) * THIN
            body = _round(centers[j, None], balls.radius[j, None], [_colour(shade, 0.7 if out else 0.12)], height)
            angle = np.linspace(0, 2 * np.pi, 65)[:, None]
            ring = centers[j] + radius * np.concatenate([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
            yield _entity(name, stamp, lines=[_line(ring, shade, 2.0)], **body)

    def _walls(self, walls: Walls, k: int, stamp: Timestamp) -> Iterator[SceneEntity]:
        if walls.normal.shape[1] == 1:
            return
        found = dict(space.faces(walls, self._low, self._high))
        for j, (first, *_) in enumerate(walls.numbers):
            if k and not self._moves[first]:
                continue
            corners = found.get(j, np.zeros((0, walls.normal.shape[1])))  # none where it is out of view
            closed = corners if len(corners) <= 2 else np.concatenate([corners, corners[:1]])
            yield _entity(f"wall {first}", stamp, lines=[_line(_in_space(closed), colour_of(walls.owners[j]), 2.0)])

    def _outlines(self, team: Team, k: int, x: np.ndarray, stamp: Timestamp) -> Iterator[SceneEntity]:
        asked = [j for j in self._traced if k == 0 or self._moves[j]]
        traced = outlines(team, asked, x[:, :2], self._low, self._high) if asked else []
        for j, found in zip(asked, traced, strict=True):
            lines = [_line(_in_space(line), colour_of((int(team.owner[j]),)), 2.0) for line in found]
            yield _entity(f"region {j}", stamp, lines=lines)


class _Robots:
    """Entities of ``/scene`` for robots: their bodies, the strokes of their headings, and the obstacles.

    Args:
        result: result of the run.
        data: its recorded agents and steps.
    """

    def __init__(self, result: Result, data: Any) -> None:
        self._found, self._map = bodies.robots(result, data)
        self._flat = data.sizes["axis"] < 3

    def headings(self, k: int, count: int) -> np.ndarray:
        """(N,) headings at step k, rad; zero without headings."""
        heading = None if self._found is None else self._found.heading
        return np.zeros(count) if heading is None else np.nan_to_num(heading[k])

    def entities(self, k: int, x: np.ndarray, stamp: Timestamp) -> Iterator[SceneEntity]:
        """The entities to write at step k, with the agents at x (N, 3). Obstacles are written once."""
        if k == 0:
            for j, each in enumerate(self._map):
                yield _entity(f"obstacle {j}", stamp, **self._obstacle(each))
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
        shade = _colour(bodies.SOLID, 0.9)
        if isinstance(each, Disc):
            return _round(_in_space(np.array([each.center])), np.array([each.radius]), [shade], 0.1 if self._flat else None)
        if isinstance(each, Box):
            low, high = (_in_space(np.array(corner)) for corner in (each.low, each.high))
            if self._flat:
                high[2] = 0.1 * float((high - low)[:2].min())
            return {"cubes": [messages.CubePrimitive(pose=_pose((low + high) / 2), size=_vector(high - low), color=shade)]}
        corners = _in_space(np.array(bodies.outline(each).vertices))
        return {"lines": [_line(corners, bodies.EDGE, 3.0)]}


def _entity(name: str, stamp: Timestamp, **parts: Any) -> SceneEntity:
    return SceneEntity(timestamp=stamp, frame_id=WORLD, id=name, **parts)


def _round(centers: np.ndarray, radii: np.ndarray, shades: Sequence[Color], height: float | None) -> dict[str, list[Any]]:
    """Balls in space; or, with a height relative to the radius, discs of the plane. centers: (K, 3); radii: (K,)."""
    cylinders, spheres = [], []
    for center, radius, shade in zip(centers, radii.tolist(), shades, strict=True):
        pose = _pose(center)
        if height is None:
            spheres.append(messages.SpherePrimitive(pose=pose, size=_vector(np.full(3, 2 * radius)), color=shade))
        else:
            size = _vector(radius * np.array([2, 2, height]))
            cylinders.append(messages.CylinderPrimitive(pose=pose, size=size, bottom_scale=1.0, top_scale=1.0, color=shade))
    return {"cylinders": cylinders, "spheres": spheres}


def _line(points: np.ndarray, shade: str, thickness: float, *, pairs: bool = False) -> Any:
    kind = messages.LinePrimitiveLineType.LineList if pairs else messages.LinePrimitiveLineType.LineStrip
    places = [messages.Point3(x=px, y=py, z=pz) for px, py, pz in points.tolist()]
    pose, colour = _pose(np.zeros(3)), _colour(shade, 0.9)
    return messages.LinePrimitive(type=kind, pose=pose, thickness=thickness, scale_invariant=True, points=places, color=colour)


def _text(name: str, place: np.ndarray) -> Any:
    shade = _colour("0.1", 1.0)
    return messages.TextPrimitive(pose=_pose(place), billboard=True, font_size=14.0, scale_invariant=True, color=shade, text=name)


def _colour(shade: str, alpha: float) -> Color:
    red, green, blue = to_rgb(shade)
    return Color(r=red, g=green, b=blue, a=alpha)
