"""Command files: timed changes of a running team. All commands are checked before the launch starts.

The file is a YAML list of mappings, or JSON with one object per line:
``{"at": 2.0, "agent": "a1", "command": "change", "constraint": "goal", …}``.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, Final, NamedTuple

import numpy as np

from consat.errors import AT_KEY, Fault, InvalidTeam, Place, closest, shown
from consat.problem.changes import adjusted, changed, changes_of, is_adjustment
from consat.problem.structure import require_connected, with_link, without_link
from consat.problem.team import Team
from consat.scenario.document import Document, Node, read

COMMANDS: Final[dict[str, tuple[str, ...]]] = {
    "change": ("agent", "constraint"), "leave": ("agent",), "join": ("agent",), "connect": ("agents",), "disconnect": ("agents",),
}  # fmt: skip
"""The commands, and the keys that each requires besides ``at``. Only ``change`` has further keys: the parameters."""
RELINK: Final = ("connect", "disconnect")
"""Commands that add or remove a link."""


class Stage(NamedTuple):
    """State of a team between two commands.

    Attributes:
        since: start of this state, s since t = 0.
        team: all agents, present or absent, with their current constraints and links.
        present: ids of the agents that are present.
    """

    since: float
    team: Team
    present: frozenset[str]

    def present_team(self) -> tuple[Team, np.ndarray]:
        """The team of the agents that are present, and their indices in `team`."""
        places = np.array([i for i, agent in enumerate(self.team.ids) if agent in self.present])
        return (self.team, places) if len(places) == self.team.count else (self.team.part(places)[0], places)


@dataclass(frozen=True)
class Timed:
    """One command.

    Attributes:
        at: time of the command, s since t = 0.
        command: one of `COMMANDS`.
        agents: ids of the agents concerned: one, or the two ends of a link.
        constraint: name of the constraint of a ``change``; else empty.
        parameters: new parameters of a ``change``, written as in a scenario.
        after: state of the team after the command.
    """

    at: float
    command: str
    agents: tuple[str, ...]
    constraint: str
    parameters: Mapping[str, Any]
    after: Stage


class Script(NamedTuple):
    """The commands of a launch.

    Attributes:
        begin: state of the team at the beginning. An agent whose first command is ``join`` is absent.
        commands: the commands, sorted by time.
    """

    begin: Stage
    commands: tuple[Timed, ...]

    @property
    def stages(self) -> list[Stage]:
        """All states of the team, in order of time."""
        return [self.begin, *(each.after for each in self.commands)]


def read_commands(text: str, file: str, team: Team, mode: str, until: float | None = None) -> Script:
    """Read the commands for a team. An empty text has none.

    Args:
        text: YAML or JSON lines.
        file: name of the file, for messages.
        team: all agents, with their constraints and links at the beginning.
        mode: communication mode of the agents.
        until: end of the launch, s; None if not known.

    Raises:
        InvalidScenario: the text has faults. The message names every fault with its line and column.
    """
    document = _document(text, file)
    entries = document.root.plain if document.root else []
    if not isinstance(entries, list):
        raise document.invalid([Fault((), "it must be a list of commands, such as - {at: 2, agent: a1, command: leave}", "commands")])
    faults = [fault for k, entry in enumerate(entries) for fault in _faults(k, entry, team, mode, until)]
    if faults or document.faults:
        raise document.invalid(faults)
    order = sorted(range(len(entries)), key=lambda k: entries[k]["at"])
    first: dict[str, str] = {}
    for k in order:
        if "agent" in entries[k]:
            first.setdefault(entries[k]["agent"], entries[k]["command"])
    stage = begin = Stage(0.0, team, frozenset(team.ids) - {agent for agent, command in first.items() if command == "join"})
    if not begin.present:
        raise document.invalid([Fault((), "nobody is there at the beginning; whose first command is to join is not", "commands")])
    commands = []
    for k in order:
        try:
            command = _after(stage, entries[k])
        except InvalidTeam as error:
            faults += [replace(fault, path=(k, *fault.path)) for fault in error.faults]
            continue
        commands.append(command)
        stage = command.after
    if faults:
        raise document.invalid(faults)
    return Script(begin, tuple(commands))


def _document(text: str, file: str) -> Document:
    """The parsed file. JSON lines become one list, with the line numbers of the file."""
    if not text.lstrip().startswith("{"):
        return read(text, file)
    nodes, faults = [], []
    for number, line in enumerate(text.splitlines(), 1):
        if line.strip():
            one = read(line, file, lambda mark, number=number: Place(number, mark.column + 1, file))  # type: ignore[misc]
            faults += one.faults
            nodes += [] if one.root is None else [one.root]
    return Document(file, Node(nodes, Place(1, 1, file)), faults)


def _faults(k: int, entry: Any, team: Team, mode: str, until: float | None) -> Iterator[Fault]:
    """Faults of a single entry, without regard to the state of the team."""
    where = f"command {k + 1}"
    if not isinstance(entry, dict):
        yield Fault((k,), f"it is {shown(entry)}, but must be a mapping such as {{at: 2, agent: a1, command: leave}}", where)
        return
    at, command = entry.get("at"), entry.get("command")
    if isinstance(at, bool) or not isinstance(at, int | float) or not 0 <= at < math.inf:
        yield Fault((k, "at") if "at" in entry else (k,), f"at is {shown(at)}, but must be a time from 0, s", where)
    elif until is not None and at > until:
        yield Fault((k, "at"), f"at is {at:g} s, but the launch ends after {until:g} s", where)
    if not isinstance(command, str) or command not in COMMANDS:
        path = (k, "command") if "command" in entry else (k,)
        yield Fault(path, f"the command is {shown(command)}{closest(command, COMMANDS)}; the commands are {', '.join(COMMANDS)}", where)
        return
    if mode == "lockstep" and command in ("change", *RELINK):
        yield Fault((k, "command"), f"mode lockstep goes as consat run does, whose team stays; {command} needs another mode", where)
    for key in COMMANDS[command]:
        if key not in entry:
            yield Fault((k,), f"{command} lacks {key}", where)
    allowed = ("at", "command", *COMMANDS[command])
    if command != "change" and (unknown := [key for key in entry if key not in allowed]):
        yield Fault((k, unknown[0]), f"{command} has no key {shown(unknown[0])}; it has {', '.join(allowed)}", where, AT_KEY)
    if command == "change" and len(entry) == len(allowed):
        yield Fault((k,), "change names no parameter, such as radius: 2", where)
    yield from _unknown(k, entry, command, team, where)


def _unknown(k: int, entry: Mapping[str, Any], command: str, team: Team, where: str) -> Iterator[Fault]:
    if command in RELINK:
        pair = entry.get("agents")
        if pair is not None and not (isinstance(pair, list) and len(pair) == 2 and pair[0] != pair[1]):
            yield Fault((k, "agents"), f"agents is {shown(pair)}, but must be two agents such as [a1, a2]", where)
            return
        named: list[tuple[tuple[int | str, ...], Any]] = [((k, "agents", j), agent) for j, agent in enumerate(pair or [])]
    else:
        named = [((k, "agent"), entry["agent"])] if "agent" in entry else []
    ids = list(team.ids)
    for path, agent in named:
        if not isinstance(agent, str) or agent not in ids:
            yield Fault(path, f"there is no agent {shown(agent)}{closest(agent, ids)}", where)


def _after(stage: Stage, entry: Mapping[str, Any]) -> Timed:
    """The command with the state of the team after it. Raises: InvalidTeam: it cannot be carried out in the given state."""
    at, command = float(entry["at"]), entry["command"]
    given = {key: value for key, value in entry.items() if key not in ("at", "command", *COMMANDS[command])}
    if command in RELINK:
        agents = tuple(entry["agents"])
        return Timed(at, command, agents, "", {}, Stage(at, _relinked(stage, command, agents), stage.present))
    agent, team, present = entry["agent"], stage.team, stage.present
    if (command == "join") == (agent in present):
        message = "it is there already" if command == "join" else f"it is not there at {at:g} s"
        raise InvalidTeam([Fault(("agent",), message, f"agent {agent!r}")])
    if command == "change":
        changes = changes_of(team, agent, entry["constraint"], given)
        team = (adjusted if is_adjustment(team, changes) else changed)(team, changes)
    else:
        present = present - {agent} if command == "leave" else present | {agent}
        if not present:
            raise InvalidTeam([Fault(("agent",), "it is the last agent; a team needs at least one", f"agent {agent!r}")])
        where = f"{'without' if command == 'leave' else 'with'} agent {agent!r}"
        require_connected(Stage(at, team, present).present_team()[0], where, ("agent",))
    return Timed(at, command, (agent,), entry.get("constraint", ""), given, Stage(at, team, present))


def _relinked(stage: Stage, command: str, agents: tuple[str, ...]) -> Team:
    change = with_link if command == "connect" else without_link
    one, other = agents
    new = change(stage.team, one, other, ("agents",))
    require_connected(stage._replace(team=new).present_team()[0], f"without the link [{one}, {other}]", ("agents",))
    return new
