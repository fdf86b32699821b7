"""HTML of teams, results, sweeps and solutions for notebooks: a small table and a figure.

Text has the colours of the notebook's theme. Figures have a white background.
"""

from __future__ import annotations

import base64
import io
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from consat.errors import counted
from consat.views import words

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from consat.problem.team import Team
    from consat.results.result import Result

MOST_ROWS, MOST_NAMES, MOST_DRAWN = 10, 4, 200
DPI: Final = 75
GOOD, BAD = "#00714f", "#b34a00"
CELL: Final = "text-align:left;padding:2px 12px 2px 0;vertical-align:top"


def _said(value: float | None) -> str:
    return words.typeset(None if value is None or not np.isfinite(value) else value, "–")


def _place(position: Sequence[float | None]) -> str:
    most = 6
    return "(" + ", ".join(_said(x) for x in position[:most]) + (", …)" if len(position) > most else ")")


def _table(head: Sequence[str], rows: Iterable[Sequence[str]], more: int = 0) -> str:
    """HTML of a table of texts. more: number of rows that are left out."""
    top = "".join(f'<th style="{CELL}">{escape(name)}</th>' for name in head)
    body = "".join("<tr>" + "".join(f'<td style="{CELL}">{escape(cell)}</td>' for cell in row) + "</tr>" for row in rows)
    left = f"<p>… and {more:,} more</p>" if more else ""
    return f'<table style="border-collapse:collapse"><thead><tr>{top}</tr></thead><tbody>{body}</tbody></table>{left}'


def _facts(facts: Iterable[tuple[str, str]]) -> str:
    rows = "".join(
        f'<tr><th style="{CELL};font-weight:normal;opacity:.7">{escape(name)}</th><td style="{CELL}">{escape(text)}</td></tr>'
        for name, text in facts
    )
    return f'<table style="border-collapse:collapse">{rows}</table>'


def _headline(name: str, text: str, good: bool | None) -> str:
    sign = "" if good is None else f'<span style="color:{GOOD if good else BAD}">{"✓" if good else "✗"}</span> '
    return f"<p><b>{escape(name)}</b>: {sign}{escape(text)}</p>"


def _image(figure: Figure | None, alt: str) -> str:
    if figure is None:
        return ""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=DPI, facecolor="white", bbox_inches="tight")
    data = base64.b64encode(buffer.getvalue()).decode()
    return f'<img alt="{escape(alt)}" style="max-width:100%" src="data:image/png;base64,{data}">'


def result(found: Result) -> str:
    """HTML of a result: outcome, agents, formation and margin."""
    from consat.views import figures

    summary = found.summary
    lower, upper = summary["bounds"]
    since = summary["satisfied_from"]
    facts = [("verdict", words.VERDICT[summary["verdict"]]), ("margin", _said(summary["margin"]))]
    if lower is not None and upper is not None:
        facts.append(("best possible", f"between {_said(lower)} and {_said(upper)}, proven"))
    if since["round"] is not None:
        facts.append(("satisfied from", f"round {since['round']:.0f}"))
    elif since["time"] is not None:
        facts.append(("satisfied from", f"t = {_said(since['time'])} s"))
    facts.append(("protocol", f"{summary['protocol']}, {summary['estimates']} estimates, seed {summary['seed']}"))
    facts += [("in the way", reason) for reason in found.reasons]
    agents, positions = summary["agents"], summary["positions"]
    table = ""
    if agents is not None and positions is not None:
        margins = {agent: np.inf if entry["margin"] is None else entry["margin"] for agent, entry in agents.items()}
        order = sorted(margins, key=margins.__getitem__)
        shown = list(agents) if len(agents) <= MOST_ROWS else order[:MOST_ROWS]
        rows = ((agent, _place(positions[agent]), _said(agents[agent]["margin"])) for agent in shown)
        table = _table(["agent" if len(agents) <= MOST_ROWS else "tightest", "position", "margin"], rows, len(agents) - len(shown))
    pictures = [
        _image(draw(found), f"{name} of {summary['scenario']}")
        for name, draw in (("formation", figures.formation), ("margin", figures.margins))
    ]
    head = _headline(summary["scenario"], words.STATUS[summary["status"]], summary["status"] == "satisfied")
    return head + _facts(facts) + table + "<br>".join(pictures)


def team(found: Team) -> str:
    """HTML of a team: agents, constraints, and a sketch."""
    shape = [
        counted(found.count, "agent"), counted(len(found.owner), "constraint"), counted(len(found.links), "link"),
        f"dimension {found.dimension}", *([] if found.unit is None else [f"lengths in {found.unit}"]),
    ]  # fmt: skip
    rows = []
    for i in range(min(found.count, MOST_ROWS)):
        mine = np.flatnonzero(np.asarray(found.owner) == i).tolist()
        names = ", ".join(str(found.names[k]) for k in mine[:MOST_NAMES]) + (
            f", and {len(mine) - MOST_NAMES} more" if len(mine) > MOST_NAMES else ""
        )
        start = found.starts[i]
        rows.append((str(found.ids[i]), names or "none", "drawn" if np.isnan(start).any() else _place(start.tolist())))
    table = _table(["agent", "constraints", "start"], rows, found.count - len(rows))
    return _headline("Team", ", ".join(shape), None) + table + _image(sketch(found), "regions, starts and links of the team")


def sketch(found: Team, x: np.ndarray | None = None) -> Figure | None:
    """Picture of a team before a run, or at positions x, (N, d). None for a large team, and for one outside the plane.

    Agents are at their starts, or at the centres of their goals. If one has neither, all are on a circle, without regions.
    """
    from matplotlib.figure import Figure
    from matplotlib.patches import Circle

    from consat.views import areas, colours
    from consat.views.shapes import shapes

    if found.count > MOST_DRAWN or found.dimension != 2:
        return None
    balls, places = shapes(found).balls, np.array(found.starts if x is None else x)
    for k in np.flatnonzero((balls.around < 0) & ~balls.keeps_out):
        for owner in balls.owners[k]:
            places[owner] = np.where(np.isnan(places[owner]), balls.center[k], places[owner])
    known = not np.isnan(places).any()
    figure = Figure(figsize=(4.6, 4.0), layout="constrained")
    axes = figure.add_subplot()
    axes.set_aspect("equal")
    if known:
        axes.set(xlabel=words.label("position x", found.unit), ylabel=words.label("position y", found.unit))
        axes.grid(color="0.92", linewidth=0.8)
        centers = balls.at(places)
        for k in np.flatnonzero(balls.around < 0):
            owners, radius = balls.owners[k], balls.radius[k]
            shade = colours.colour_of(owners) if found.count <= MOST_ROWS else colours.AREA
            style = areas.keep_out_style(colours.SHARED) if balls.keeps_out[k] else {"facecolor": shade, "alpha": 0.15}
            axes.add_patch(Circle(tuple(centers[k]), radius, **style))
            axes.add_patch(Circle(tuple(centers[k]), radius, fill=False, edgecolor=colours.SHARED if balls.keeps_out[k] else shade))
    else:
        angle = 2 * np.pi * np.arange(found.count) / found.count + np.pi / 2
        places = np.stack([np.cos(angle), np.sin(angle)], axis=1)
        axes.set_axis_off()
    axes.plot(*np.insert(places[found.links], 2, np.nan, axis=1).reshape(-1, 2).T, color=colours.LINK, linewidth=0.9, zorder=2)
    few = found.count <= MOST_ROWS
    for i in range(found.count):
        shade, shape = (colours.colour(i), colours.marker(i)) if few else (colours.AREA, "o")
        axes.plot(*places[i], shape, color=shade, markeredgecolor="white", markersize=8 if few else 4, zorder=3)
        if few:
            name = words.plain(str(found.ids[i]), 14)
            axes.annotate(name, places[i], (6, 6), textcoords="offset points", color=shade, weight="bold", zorder=4)
    axes.margins(0.12)
    return figure


def solution(answer: Mapping[str, Any], found: Team | None) -> str:
    """HTML of the answer of `consat.solve`: verdict, best margin, positions, and binding constraints."""
    facts = [("best margin", _said(answer["margin"]) + (", proven: none is better" if answer["proven"] else ""))]
    if not answer["proven"] and answer["bounds"][1] is not None:
        facts.append(("none is better than", _said(answer["bounds"][1])))
    facts += [("method", answer["method"]), *(("reason", text) for text in answer["reasons"])]
    binding: dict[str, list[str]] = {}
    for row in answer["binding"]:
        binding.setdefault(row["agent"], []).append(f"{row['constraint']} {row['multiplier']:.2f}")
    agents = sorted(answer["positions"], key=lambda agent: agent not in binding)[:MOST_ROWS]
    rows = ((agent, _place(answer["positions"][agent]), ", ".join(binding.get(agent, []))) for agent in agents)
    table = _table(["agent", "position", "binds, with its multiplier"], rows, len(answer["positions"]) - len(agents))
    picture = ""
    if found is not None and all(None not in place for place in answer["positions"].values()):
        picture = _image(
            sketch(found, np.array(list(answer["positions"].values()), dtype=float)), f"best formation of {answer['scenario']}"
        )
    good = {"feasible": True, "infeasible": False}.get(answer["verdict"])
    return _headline(answer["scenario"], words.VERDICT[answer["verdict"]], good) + _facts(facts) + table + picture


def sweep(summary: Mapping[str, Any], runs: Sequence[Mapping[str, Any]]) -> str:
    """HTML of a sweep: one row for each combination of values, and the figure."""
    from consat.views import sweeps

    groups = summary["groups"]
    flows = groups[0]["messages"] is None
    head = [*summary["over"], "satisfied", "time to satisfaction, s" if flows else "rounds to satisfaction", "margin"]
    rows = []
    for group in groups[:MOST_ROWS]:
        cells = [str(value) for value in group["values"].values()]
        cells.append(f"{group['success']:.0%} of {group['runs']}")
        for name in ("satisfied_from", "margin"):
            spread = group[name]
            cells.append("–" if spread is None else f"{_said(spread['median'])} ({_said(spread['10 %'])} to {_said(spread['90 %'])})")
        rows.append(cells)
    note = "<p>median over the seeds (from the 10th to the 90th percentile)</p>"
    title = f"{counted(summary['count'], 'run')} of {summary['protocol']} in {summary['seconds']:.1f} s"
    good = all(group["success"] == 1 for group in groups)
    picture = _image(sweeps.draw(summary, runs), f"sweep of {summary['scenario']}")
    return _headline(summary["scenario"], title, good) + _table(head, rows, len(groups) - len(rows)) + note + picture
