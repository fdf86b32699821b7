"""Replay of a run as one HTML file that works offline. The page loads nothing and evaluates nothing.

The file holds ``replay.html``, the style ``page.css``, the script ``replay.js``, which is built from ``web/``, and the data as JSON. Arrays
are base64 of little-endian float32.
"""

from __future__ import annotations

import base64
import json
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.colors import to_hex

from consat.errors import InvalidSettings, counted
from consat.problem.team import Team
from consat.results.result import Result
from consat.scenario.robots import obstacle_data
from consat.views import bodies, page_data, words
from consat.views.colours import FEW, classes
from consat.views.page import page as assembled
from consat.views.record import Record, spread
from consat.views.regions import MOST_TRACED, outlines
from consat.views.shapes import MOST_SHAPES, Shapes, moves, shapes

SCHEMA: Final = "consat.replay/1"
MOST_NUMBERS: Final = 2_000_000
"""Most numbers of a record. Of a longer record, some steps are replayed, spread by movement and time."""
MOST_OUTLINED: Final = 40
"""Number of samples at which moving regions are written."""
SPREAD: Final = 200
"""Number of moments by which the page paces its time."""
MOVEMENT: Final = 0.6
"""Weight of the distance travelled in that pace; the rest is the clock."""


def save(result: Result, path: str | os.PathLike[str]) -> Path:
    """Write the page.

    Args:
        result: result of a run.
        path: path of the HTML file.

    Raises:
        InvalidSettings: no positions were recorded.
    """
    target = Path(path)
    text = page(result)
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_text(text, encoding="utf-8")
    return target


def page(result: Result) -> str:
    """The page as text; see `save`."""
    if "position" not in result.data:
        raise InvalidSettings("nobody's positions were recorded, so there is nothing to replay; run with --record all")
    data = json.dumps(document(result), separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    summary = result.summary
    status = summary["status"]
    good = status == "satisfied"
    count = summary["count"]
    few = result.data.sizes["agent"] <= FEW
    parts = {
        "title": escape(f"{summary['scenario']}: {status}"),
        "name": escape(str(summary["scenario"])),
        "tone": "good" if good else "bad",
        "sign": "✓" if good else "✗",
        "status": escape(words.STATUS[status]),
        "chart": escape(f"at the end {words.typeset(summary['margin'])}"),
        "agents": counted(count, "agent") if few else f"{counted(count, 'agent')}, the tightest first",
        "scale": "" if few else _scale(result),
        "scale_hidden": "hidden" if few else "",
        "facts": "".join(f"<dt>{escape(name)}</dt><dd>{escape(text)}</dd>" for name, text in _facts(result)),
        "data": data,
    }
    return assembled("replay", ("page.css",), parts)[0]


def _facts(result: Result) -> Iterator[tuple[str, str]]:
    summary = result.summary
    yield "verdict", words.VERDICT[summary["verdict"]]
    lower, upper = summary.get("bounds") or (None, None)
    if lower is not None and upper is not None:
        ends = dict.fromkeys(map(words.typeset, (lower, upper)))  # one, if they look alike
        yield "best possible", f"{' to '.join(ends)}, proven"
    since = summary["satisfied_from"]
    if since["time"] is not None:
        yield "satisfied from", f"t = {words.typeset(since['time'])} s"
    elif since["round"] is not None:
        yield "satisfied from", f"round {since['round']:.0f}"
    yield "protocol", f"{summary['protocol']}, {summary['estimates']} estimates, seed {summary['seed']}"
    for name, count in (("rounds", summary["rounds"]), ("messages", summary["messages"])):
        if count is not None:
            yield name, f"{count:,}"
    yield from words.motion(summary)
    for reason in result.reasons:
        yield "in the way", reason


def _scale(result: Result) -> str:
    """The colour scale of margins as SVG."""
    palette, edges = _palette(result)
    wide = 100 / len(palette)
    bars = "".join(f'<rect x="{wide * k:.2f}%" y="0" width="{wide:.2f}%" height="14" fill="{shade}"/>' for k, shade in enumerate(palette))
    texts = "".join(
        f'<text x="{wide * (k + 1):.2f}%" y="27" text-anchor="middle">{words.typeset(edge)}</text>' for k, edge in enumerate(edges)
    )
    return f'<h2>margin (red: violated)</h2><svg role="img" aria-label="Colours of margins, from violated to satisfied">{bars}{texts}</svg>'


def _palette(result: Result) -> tuple[list[str], list[float]]:
    """Colours, from below the first edge to above the last, and the edges."""
    palette, _, edges, _ = classes(result.data["agent_margin"].values[-1])
    inside = [palette(k) for k in range(len(edges) - 1)]
    every: list[Any] = [palette.get_under(), *inside, palette.get_over()]
    return [to_hex(shade) for shade in every], [float(edge) for edge in edges]


def _packed(values: np.ndarray, kind: str = "<f4") -> str:
    with np.errstate(over="ignore"):
        return base64.b64encode(np.ascontiguousarray(values).astype(kind).tobytes()).decode()


def document(result: Result) -> dict[str, Any]:
    """Data of the page, for JSON (schema consat.replay/1).

    ``x`` is (T, N, d) with d at most 3, ``agent_margin`` (T, N), ``margin`` and ``steps`` (T,); ``links`` (L, 2) int32; ``balls``,
    ``walls`` and ``outlines`` are the regions; ``obstacles`` as in a scenario; ``bodies`` of robots. ``spread`` are moments, sample indices
    spread by movement and time.
    """
    record, summary = Record(result), result.summary
    data, team, seen = record.data, record.team, record.x[: record.last + 1, :, :3]
    most = max(2, MOST_NUMBERS // max(1, math.prod(seen.shape[1:])))
    chosen = np.arange(len(seen)) if len(seen) <= most else _samples(seen, most)
    x, times, steps = record.x[chosen, :, :3], record.times[chosen], record.steps[chosen]
    dimension = x.shape[2]
    robots, stand = bodies.robots(result, data)
    low, high, found = _regions(team, x, times, bodies.bounds(stand, dimension) if dimension > 1 else None)
    shades, edges = _palette(result)
    bound = data["bound"].values[chosen] if "bound" in data and np.isfinite(data["bound"].values).any() else None
    return {
        "schema": SCHEMA,
        "name": summary["scenario"],
        "unit": None if team is None else team.unit,
        "clock": record.clock,
        "dimension": dimension,
        "ids": record.ids,
        "verdict": summary["verdict"],
        "bounds": None if summary.get("verdicts") else summary.get("bounds"),
        "verdicts": [[each["from"], each["to"], each["verdict"]] for each in summary.get("verdicts") or ()],
        "since": summary["satisfied_from"]["time" if record.clock == "time" else "round"],
        "steps": _packed(steps),
        "x": _packed(np.nan_to_num(x)),
        "margin": _packed(record.margin[chosen]),
        "agent_margin": _packed(record.agent_margin[chosen]),
        "bound": None if bound is None else _packed(bound),
        "links": _packed(team.links if team is not None and len(team.links) <= MOST_SHAPES else np.zeros((0, 2)), "<i4"),
        "low": [round(float(value), 6) for value in low],
        "high": [round(float(value), 6) for value in high],
        "spread": [round(float(value), 3) for value in spread(x, steps, SPREAD, MOVEMENT)],
        "scale": {"edges": edges, "shades": shades},
        "bodies": None if robots is None else _bodies(robots, chosen),
        "obstacles": [obstacle_data(each) for each in stand],
        **found,
    }


def _bodies(found: bodies.Bodies, chosen: np.ndarray) -> dict[str, Any]:
    """Sizes of bodies, and headings, (T, N), if there are any."""
    heading = None if found.heading is None or not found.turns.any() else _packed(np.nan_to_num(found.heading[chosen]))
    return {"radius": found.radius.tolist(), "offset": found.offset.tolist(), "heading": heading}


def _samples(x: np.ndarray, count: int) -> np.ndarray:
    """Indices of at most `count` samples of x, (T, N, d), spread by movement and time."""
    return np.unique(np.round(spread(x, np.arange(len(x)), count, MOVEMENT)).astype(int))


def _regions(
    team: Team | None, x: np.ndarray, times: np.ndarray, stand: np.ndarray | None
) -> tuple[np.ndarray, np.ndarray, dict[str, list[Mapping[str, Any]]]]:
    """The box to show, lower and upper corner, and the regions. stand: (B, 2, d) boxes around obstacles."""
    low, high = page_data.frame(team, x, times, stand)
    if team is None or len(team.owner) > MOST_SHAPES:
        return low, high, {"balls": [], "walls": [], "outlines": []}
    found = shapes(team, times[-1])
    moments = _samples(x, MOST_OUTLINED) if team.moves else np.zeros(0, dtype=int)
    seen = [shapes(team, times[moment]) for moment in moments]
    regions: dict[str, list[Mapping[str, Any]]] = {
        "balls": [
            {**ball, "track": _ball_track(moments, seen, k) if seen and found.balls.moves[k] else None}
            for k, ball in enumerate(page_data.balls_of(team, found.balls))
        ],
        "walls": _walls(team, [*seen, found], moments, (low, high)),
        "outlines": _outlines(team, found.others, x, times, low, high),
    }
    return low, high, regions


def _ball_track(moments: np.ndarray, seen: Sequence[Shapes], k: int) -> Mapping[str, Any]:
    """Centre and radius of ball k at some samples. The page interpolates between them."""
    return {
        "at": moments.tolist(),
        "center": [np.round(each.balls.center[k], 6).tolist() for each in seen],
        "radius": [round(float(each.balls.radius[k]), 6) for each in seen],
    }


def _walls(team: Team, seen: Sequence[Shapes], moments: np.ndarray, box: tuple[np.ndarray, np.ndarray]) -> list[Mapping[str, Any]]:
    """The half-spaces, those that move with their corners and normals at some samples; without corners where they are out of view.

    Args:
        team: the team.
        seen: its geometry at the samples, and, as the last, at the end.
        moments: the samples.
        box: lower and upper corner of the view.
    """
    *before, last = ({wall["place"]: wall for wall in page_data.walls_of(team, each.walls, *box)} for each in seen)
    found: list[Mapping[str, Any]] = []
    ties = moves(team)
    for k, numbers in enumerate(seen[-1].walls.numbers):
        known = [each[k] for each in (*before, last) if k in each]
        if not known or not (before and ties[numbers[0]]):
            found += known[-1:]
            continue
        normals = [np.round(each.walls.normal[k], 6).tolist() for each in seen[:-1]]
        corners = [each[k]["corners"] if k in each else [] for each in before]
        found.append({**known[-1], "track": {"at": moments.tolist(), "corners": corners, "normal": normals}})
    return found


def _outlines(
    team: Team, numbers: np.ndarray, x: np.ndarray, times: np.ndarray, low: np.ndarray, high: np.ndarray
) -> list[Mapping[str, Any]]:
    """Boundaries of other ψ in the plane; of those that move, at some samples."""
    if team.dimension != 2 or not 0 < len(numbers) <= MOST_TRACED:
        return []
    moving = moves(team)[numbers]
    moments = _samples(x, MOST_OUTLINED) if moving.any() else np.array([len(x) - 1])
    traced = [outlines(team.at(times[moment]), numbers.tolist(), x[moment], low, high) for moment in moments]
    digits = max(0, 4 - int(np.floor(np.log10(float((high - low).max()) or 1.0))))
    found: list[Mapping[str, Any]] = []
    for k, constraint in enumerate(numbers.tolist()):
        at = moments.tolist() if moving[k] else [0]
        lines = [[np.round(line, digits).ravel().tolist() for line in each[k]] for each in (traced if moving[k] else traced[-1:])]
        found.append({"at": at, "lines": lines, "owners": [int(team.owner[constraint])]})
    return found
