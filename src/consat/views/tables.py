"""Terminal output of `consat check`, `consat solve` and `consat sweep`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from rich.console import RenderableType
from rich.markup import escape
from rich.table import Table

from consat.errors import counted
from consat.views.words import ROUTE, VERDICT, number

MOST_ROWS = 30
"""Most rows of a table. Of longer lists the beginning is shown."""
CURVATURE = {
    "strictly-concave": "strictly concave",
    "concave": "concave",
    "unknown": "[yellow]unknown[/]",
    "not-concave": "[yellow]not concave[/]",
}
ANSWER = {True: "[green]yes[/]", False: "[red]no[/]", None: "[yellow]open[/]"}


def check(name: str, findings: Mapping[str, Any]) -> Iterator[RenderableType]:
    """Render the findings of `consat.certify.assumptions.report`; `name`: of the scenario."""
    clusters = findings["clusters"]
    shape = [
        counted(findings[key], noun) for key, noun in (("count", "agent"), ("constraint_count", "constraint"), ("cluster_count", "cluster"))
    ]
    yield f"[bold]{escape(name)}[/]: {', '.join(shape)}"
    if clusters is not None and 1 < len(clusters) <= MOST_ROWS:
        yield "  " + "; ".join(escape("{" + ", ".join(cluster[:8]) + (", …" if len(cluster) > 8 else "") + "}") for cluster in clusters)
    table = _table("agent", "constraint", "reads", "curvature", "strict in own position")
    constraints = findings["constraints"] or []
    for row in constraints[:MOST_ROWS]:
        strict = "yes" if row["strict_in_own"] else "no"
        table.add_row(escape(row["agent"]), escape(row["name"]), escape(", ".join(row["reads"])), CURVATURE[row["curvature"]], strict)
    yield table
    if len(constraints) > MOST_ROWS:
        yield f"  … and {len(constraints) - MOST_ROWS} more; --json lists all"
    facts = ("convex", "convex"), ("one optimum", "unique_optimum"), ("bounded", "bounded")
    yield "   ".join(f"{words}: {ANSWER[findings[key]]}" for words, key in facts)
    if "protocol" in findings:
        route = "" if findings["route"] is None else f", along {ROUTE[findings['route']]}"
        yield f"protocol: {findings['protocol']}{route}" + (f" ({findings['why']})" if findings["why"] else "")
    for assumption in findings["assumptions"]:
        yield f"Assumption {assumption['number']}: {ANSWER[assumption['holds']]}. {escape(assumption['what'])}"
        if assumption["cure"]:
            yield f"  [bold]→[/] {escape(assumption['cure'])}"
    for warning in findings.get("warnings", ()):
        yield f"[yellow]warning:[/] {escape(warning)}"


def solve(answer: Mapping[str, Any]) -> Iterator[RenderableType]:
    """Render the answer of `consat.solve`."""
    yield f"[bold]{escape(answer['scenario'])}[/]: {VERDICT[answer['verdict']]}"
    yield f"  {_best(answer)}"
    yield f"  {escape(answer['method'])}"
    table = _table("agent", "position", "binds", "multiplier")
    binding: dict[str, list[tuple[str, float]]] = {}
    for row in answer["binding"]:
        binding.setdefault(row["agent"], []).append((row["constraint"], row["multiplier"]))
    agents = sorted(answer["positions"], key=lambda agent: -max((m for _, m in binding.get(agent, [])), default=0.0))
    for agent in agents[:MOST_ROWS]:
        position = "(" + ", ".join(number(x, 6) for x in answer["positions"][agent]) + ")"
        names, values = zip(*binding.get(agent, [("", None)]), strict=True)
        table.add_row(escape(agent), position, escape("\n".join(names)), "\n".join("" if v is None else f"{v:.3f}" for v in values))
    yield table
    if len(agents) > MOST_ROWS:
        yield f"  … and {len(agents) - MOST_ROWS} agents more; --json lists all"
    for reason in answer["reasons"]:
        yield f"[bold]→[/] {escape(reason)}"


def _best(answer: Mapping[str, Any]) -> str:
    """The best margin found, and what is proven about it."""
    upper = answer["bounds"][1]
    if answer["margin"] is None:
        return "best margin unbounded"
    if answer["proven"]:
        return f"best margin {number(answer['margin'], 6)}, proven: none is better"
    return f"best margin found {number(answer['margin'], 6)}; " + (
        "no upper bound is proven" if upper is None else f"proven: none is better than {number(upper, 6)}"
    )


def sweep(summary: Mapping[str, Any]) -> Iterator[RenderableType]:
    """Render the summary of `consat.sweep`: one row for each combination of values."""
    groups = summary["groups"]
    each = f", {counted(groups[0]['runs'], 'seed')} each" if len(groups) > 1 else ""
    runs = f"{counted(summary['count'], 'run')} of {summary['protocol']}{each}, in {summary['seconds']:.1f} s"
    yield f"[bold]{escape(summary['scenario'])}[/]: {runs}"
    flows = groups[0]["messages"] is None
    since = "time to satisfaction, s" if flows else "rounds to satisfaction"
    table = _table(*map(escape, summary["over"]), "satisfied", since, "10 % – 90 %", "margin", "10 % – 90 %")
    for column in table.columns[len(summary["over"]) :]:
        column.justify = "right"
    for group in groups[:MOST_ROWS]:
        cells = [escape(str(value)) for value in group["values"].values()]
        colour = "green" if group["success"] == 1 else "yellow" if group["success"] else "red"
        cells.append(f"[{colour}]{group['success']:.1%}[/]")
        for name in ("satisfied_from", "margin"):
            found = group[name]
            cells += ["–", ""] if found is None else [
                f"{found['mean']:.3g} ± {found['std']:.2g}", f"{found['10 %']:.3g} – {found['90 %']:.3g}"
            ]  # fmt: skip
        table.add_row(*cells)
    yield table
    if len(groups) > MOST_ROWS:
        yield f"  … and {len(groups) - MOST_ROWS} more; --json and --out list all"


def _table(*columns: str) -> Table:
    table = Table(box=None, pad_edge=True, header_style="dim")
    for column in columns:
        table.add_column(column, overflow="fold")
    return table
