"""Texts: of a run's summary, as ``print(result)`` shows it, and of the numbers, names and labels of figures and pages."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from consat.errors import counted

MOST_AGENTS = 10
"""Most agents whose positions are listed. Of a larger team, only the agents with the smallest margins are named."""
MOST_BINDING, MOST_VIOLATED, MOST_AXES, MOST_LETTERS = 5, 3, 6, 24
MOST_INTERVALS, MOST_STUCK = 6, 10
SLIGHT = 0.01
"""Smallest multiplier of a constraint that is listed as binding; and smallest share of a run for which an undecided interval is listed."""

STATUS = {
    "satisfied": "every constraint holds",
    "least-violating": "the constraints cannot all hold; this formation violates them about as little as possible",
    "not-converged": "not every constraint holds",
    "diverged": "the run diverged",
}
ENDING = {
    "settled": "the team has settled",
    "out of time": "the run ended when its time was up",
    "too stiff": "the run ended early, since the flow became too stiff",
    "interrupted": "the run was interrupted",
}
KNOWN = {
    "satisfied": "each that every constraint holds",
    "infeasible": "each that the constraints cannot all hold, by a proof of the team's own",
}
ROUTE = {"tree": "a tree", "links": "the links"}
"""Routes of the copies: along which links they are sent."""
BEST = "max-min"
"""The protocol that converges to the best margin."""
VERDICT = {
    "feasible": "feasible: the constraints can all hold",
    "infeasible": "infeasible: proven, the constraints cannot all hold",
    "undecided": "undecided: whether the constraints can all hold is open",
}


def summary(summary: Mapping[str, Any], reasons: Sequence[str] = ()) -> str:
    """Text of a summary of a run.

    Args:
        summary: as ``consat run --json`` prints it.
        reasons: sentences that say which constraints conflict.
    """
    status, ending = STATUS[summary["status"]], ENDING.get(summary.get("ending", ""))
    lines = [f"{summary['scenario']}: {status}" + (f"; {ending}" if ending and summary["status"] != "diverged" else "")]
    for name, value in (
        *_outcome(summary),
        *motion(summary),
        *_effort(summary),
        *_who(summary),
        *(("in the way", text) for text in reasons),
        *(("warning", text) for text in summary.get("warnings", ())),
    ):
        lines.append(f"  {name:<16}{value}")
    return "\n".join(lines)


def sweep(summary: Mapping[str, Any]) -> str:
    """Text of a sweep's summary: one line for each combination of values."""
    lines = [f"{summary['scenario']}: {counted(summary['count'], 'run')} of {summary['protocol']} in {summary['seconds']:.1f} s"]
    for group in summary["groups"]:
        named = ", ".join(f"{path} = {value}" for path, value in group["values"].items()) or "all"
        since, margin = ("none" if group[k] is None else number(group[k]["mean"]) for k in ("satisfied_from", "margin"))
        lines.append(f"  {named}: {group['success']:.1%} satisfied, from {since} on the mean; margin {margin} on the mean")
    return "\n".join(lines)


def _outcome(summary: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    yield "verdict", VERDICT[summary["verdict"]]
    yield "margin", f"{number(summary['margin'])} (smooth margin {number(summary['smooth_margin'])})"
    lower, upper = summary.get("bounds") or (None, None)
    if lower is not None and upper is not None:
        yield "best possible", f"between {number(lower)} and {number(upper)}, proven"
    restarts = summary.get("restarts")
    if restarts is not None:
        yield "best of", f"{counted(restarts['count'], 'start')}; {restarts['satisfied']} of them end with every constraint satisfied"
    if summary["status"] == "not-converged" and summary["verdict"] == "undecided" and summary["margin"] is not None:
        yield "violation", "the least found, not proven to be the least possible"
    since = summary["satisfied_from"]
    if since["time"] is not None:
        yield "satisfied from", f"t = {number(since['time'])} s"
    elif since["round"] is not None:
        yield "satisfied from", f"round {since['round']:.0f}"
    else:
        yield "satisfied from", "not at the end of the run"

    if summary.get("known"):
        since = "" if summary.get("known_from") is None else f", from {_when(summary)}"
        yield "agents know", KNOWN[summary["known"]] + since

    way = summary.get("on_the_way")
    if way is not None and way["violated"] and summary["status"] != "diverged":
        yield "on the way", _way(summary, way)
    advice = _advice(summary)
    if advice:
        yield "what to do", advice


def _when(summary: Mapping[str, Any]) -> str:
    since = summary["known_from"]
    return f"round {since:.0f}" if summary.get("rounds") is not None else f"t = {number(since)} s"


def motion(summary: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield the lines, name and text, about moving constraints and about robots."""
    if summary.get("verdicts"):
        yield "over time", over_time(summary)
        yield "kept up", kept_up(summary)
    if summary.get("robots"):
        yield "bodies", bodies(summary)


def over_time(summary: Mapping[str, Any]) -> str:
    """Text of the intervals in which moving constraints can, or cannot, all hold. Short undecided intervals are left out."""
    verdicts = summary["verdicts"]
    duration = verdicts[-1]["to"]
    certain = [each for each in verdicts if each["verdict"] != "undecided" or each["to"] - each["from"] >= SLIGHT * duration]
    spans = [f"{each['verdict']} from {number(each['from'])} to {number(each['to'])} s" for each in certain[:MOST_INTERVALS]]
    left = len(certain) - len(spans)
    return "; ".join(spans) + (f"; and {left} more intervals" if left else "")


def kept_up(summary: Mapping[str, Any]) -> str:
    """Text of the share of time in which all moving constraints held."""
    motion = summary["motion"]
    share = motion["satisfied_share_after"]
    if share is None:
        return "never: at no time did every constraint hold"
    duration, rounds = motion["duration"], summary["rounds"]
    later = motion["satisfied_share"] / share  # both count the same satisfied rounds: the ratio is the share of later rounds
    before = (1 - later) * (rounds + 1) / max(rounds, 1) * duration
    when = "at all times" if share == 1 else f"for {math.floor(1000 * share) / 10:g} % of the time"
    return f"every constraint held {when} after t = {number(before)} s; worst margin {number(motion['worst_margin_after'])}"


def bodies(summary: Mapping[str, Any]) -> str:
    """Text of contacts, smallest distances between robots and to obstacles, and robots that were stuck."""
    motion = summary["motion"]
    gap, clear, contacts = (motion[key] for key in ("smallest_distance", "clearance", "contacts"))
    parts = ["nobody touched" if not contacts else counted(contacts, "pair", "pairs") + " touched"]
    near = [f"{number(gap)} m apart at least"] if gap is not None else []
    near += [f"{number(clear)} m from obstacles"] if clear is not None else []
    parts += [", ".join(near)] if near else []
    parts += [f"bodies and contacts by {simulator}"] if (simulator := motion.get("simulator")) else []
    stuck = [_short(agent) for agent in motion["stuck"]]
    more = f", and {len(stuck) - MOST_STUCK} more" if len(stuck) > MOST_STUCK else ""
    return "; ".join([*parts, *([f"stuck: {', '.join(stuck[:MOST_STUCK])}{more}"] if stuck else [])])


def _way(summary: Mapping[str, Any], way: Mapping[str, Any]) -> str:
    """Text of the constraints that were violated for the largest share of a run, whether or not they hold at the end."""
    worst = way["worst"]
    shares = [(worst["violated_share"], worst["agent"], worst["constraint"])]
    if summary.get("agents") is not None:
        shares = [
            (constraint["violated_share"], agent, constraint["name"])
            for agent, entry in summary["agents"].items()
            for constraint in entry["constraints"]
            if constraint["violated_share"]
        ]
    shares.sort(key=lambda each: -each[0])
    (share, agent, name), *others = shares[:MOST_VIOLATED]
    first = f"{_short(agent)}: {_short(name)} violated for {_share(share)} of the run"
    named = ", ".join([first, *(f"{_short(agent)}: {_short(name)} for {_share(share)}" for share, agent, name in others)])
    left = way["violated"] - min(len(shares), MOST_VIOLATED)
    more = f", and {left:,} more" if left else ""
    return named + more


def _share(share: float) -> str:
    return f"{share:.0%}" if share >= 0.01 else "less than 1%"


def _advice(summary: Mapping[str, Any]) -> str | None:
    """Advice for a run that did not converge and was not interrupted; else None."""
    if summary["status"] != "not-converged" or summary.get("ending") == "interrupted":
        return None
    settled = summary.get("ending") == "settled"
    if summary["protocol"] == BEST:
        return (
            "other starts (--restarts 20) may end better: nothing proves that this is the best"
            if settled
            else "give it more rounds (--rounds)"
        )
    best = f"protocol {BEST} (--protocol {BEST}) goes on until the margin is the best possible"
    return best if settled else f"{best}; --stop converged, until the team has settled"


def _effort(summary: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    route = f" along {ROUTE[summary['route']]}" if summary.get("route") else ""
    yield "protocol", f"{summary['protocol']}{route}, {summary['estimates']} estimates, seed {summary['seed']}"
    units = (
        ("rounds", "round", "rounds"), ("messages", "message", "messages"), ("floats_sent", "number sent", "numbers sent"),
        ("bytes", "byte", "bytes"),
    )  # fmt: skip
    effort = [counted(summary[key], *unit) for key, *unit in units if summary.get(key) is not None]
    if summary.get("time") is not None:
        effort.insert(0, f"until t = {number(summary['time'])} s")
    if effort:
        yield "effort", ", ".join(effort)


def _who(summary: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield the lines about binding constraints and positions of the agents."""
    agents, positions = summary.get("agents"), summary.get("positions")
    if agents is None or positions is None:
        yield "agents", f"{summary['count']:,}, too many to list"
        return
    pulls = [
        (constraint["multiplier"], f"{_short(agent)}: {_short(constraint['name'])}")
        for agent, entry in agents.items()
        for constraint in entry["constraints"]
        if (constraint["multiplier"] or 0.0) >= SLIGHT
    ]
    pulls.sort(key=lambda pull: -pull[0])
    if pulls and summary["status"] != "diverged":
        more = f", and {len(pulls) - MOST_BINDING} more" if len(pulls) > MOST_BINDING else ""
        yield "binding", ", ".join(f"{name} {multiplier:.2f}" for multiplier, name in pulls[:MOST_BINDING]) + more
    if len(agents) > MOST_AGENTS:
        margins = sorted((entry["margin"], agent) for agent, entry in agents.items() if entry["margin"] is not None)
        yield (
            "agents",
            f"{len(agents):,}; the tightest: " + ", ".join(f"{_short(agent)} ({number(margin)})" for margin, agent in margins[:3]),
        )
        return
    width = max(len(_short(agent)) for agent in agents)
    places = _places(list(positions.values()))
    for k, (agent, entry) in enumerate(agents.items()):
        own = f"margin {number(entry['margin'])}" if entry["constraints"] else "no constraints"
        yield "" if k else "positions", f"{_short(agent):<{width}}  {places[k]}  {own}"


def _places(positions: Sequence[Sequence[float | None]]) -> list[str]:
    """Positions as aligned columns. The number of decimals depends on the largest coordinate."""
    largest = max((abs(x) for position in positions for x in position if x is not None), default=0.0)
    if largest and not 1e-3 <= largest < 1e6:
        texts = [[number(x) for x in position] for position in positions]
    else:
        decimals = 3 - math.floor(math.log10(largest)) if 0 < largest < 1e3 else 0
        texts = [["none" if x is None else f"{round(x, decimals) + 0.0:.{decimals}f}" for x in position] for position in positions]
    width = max(len(text) for row in texts for text in row)
    return ["(" + ", ".join(f"{text:>{width}}" for text in row[:MOST_AXES]) + (", ...)" if len(row) > MOST_AXES else ")") for row in texts]


def number(value: float | None, digits: int = 4, missing: str = "none") -> str:
    """A number as text of the terminal; `missing` for None."""
    return missing if value is None else f"{value:.{digits}g}"


def typeset(value: float | None, missing: str = "none") -> str:
    """A number as text of figures and pages: three digits, an integer from 1000 to 10⁶, a true minus sign; `missing` for None."""
    return missing if value is None else (f"{value:.0f}" if 1e3 <= abs(value) < 1e6 else f"{value:.3g}").replace("-", "−")


def plain(text: str, longest: int = 34) -> str:
    """A name as text for matplotlib: shortened to `longest` characters, with dollar signs escaped, which else begin a formula."""
    return (text if len(text) <= longest else text[: longest - 1] + "…").replace("$", r"\$")


def label(what: str, unit: str | None) -> str:
    """Label of an axis: the quantity, and the unit if there is one."""
    return what if unit is None else f"{what} [{plain(unit)}]"


def _short(name: str) -> str:
    return name if len(name) <= MOST_LETTERS else name[: MOST_LETTERS - 3] + "..."
