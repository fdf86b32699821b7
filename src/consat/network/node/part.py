"""The part of a scenario that one agent gets: its own constraints, the positions that it holds, its neighbours, and common knowledge.

`split` computes the parts of a scenario; `write_part` and `read_part` write and read them as private files. A file contains a scenario with
one agent, in the format of scenario files, inside a frame with the data for communication. No text in it is evaluated as code. A file
discloses only the names of the other agents, and for neighbours their addresses, the positions that both hold, the number of links that
share each of these at the other end, and the variables exchanged with them.
"""

from __future__ import annotations

import functools
import hashlib
import json
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
from pydantic import Field, StringConstraints, ValidationError

from consat.errors import AT_KEY, Fault, InvalidSettings, closest, counted, shown
from consat.numerics import float64
from consat.problem.agent import Agent
from consat.problem.objective import Nu
from consat.problem.team import Team
from consat.scenario import Scenario, dump
from consat.scenario.document import LARGEST, Document, decode, read
from consat.scenario.robots import Robots
from consat.scenario.schema import build
from consat.scenario.writing import write
from consat.settings import Gain, Model, Number, Settings, Smoothing

VERSION: Final = 2
"""Version of the file format; other versions are refused. Version 2 added the links along which positions and the level are exchanged."""
PORT: Final = 7447
"""Default port of the first agent."""

RUNS: Final = {"interior-point": "interior-point", "admm": "admm", "link": "gradient-flow", "lockstep": "interior-point"}
"""Default protocol of each mode."""

Word = Annotated[str, StringConstraints(min_length=1, max_length=200)]
Endpoint = Annotated[str, StringConstraints(pattern=r"^(tcp|tls|udp|quic)/[^\s/]+:[0-9]{1,5}$")]


class Neighbour(Model):
    """What an agent knows about one neighbour.

    Attributes:
        id: id of the neighbour.
        address: address at which it listens.
        shares: agents whose positions both ends hold, in the team's order.
        degrees: for each agent in `shares` the number of links over which the neighbour shares its position.
        travels: the agents in `shares` whose positions the interior-point protocol exchanges over this link (trees of their holders).
        level: whether the interior-point protocol exchanges the level over this link (spanning tree of the cluster).
    """

    id: Word
    address: Endpoint
    shares: tuple[Word, ...] = Field(min_length=1)
    degrees: tuple[Annotated[int, Field(ge=1, le=10**6)], ...]
    travels: tuple[Word, ...]
    level: bool


class _File(Model):
    """Schema of the frame of a part file; see `Part`."""

    version: int = Field(alias="consat-part")
    run: Annotated[str, StringConstraints(pattern=r"^[A-Za-z0-9_-]{1,64}$")]
    agent: Word
    listen: Endpoint
    length: Gain
    psi: Gain
    center: tuple[Number, ...]
    reach: Gain
    convex: bool
    exact: bool
    hops: Annotated[int, Field(ge=0, le=10**6)]
    first: dict[Word, tuple[Number, ...]]
    absent: tuple[Word, ...] = ()
    extent: Annotated[Number, Field(ge=0)] = 0.0
    epoch: Number | None = None
    generation: Annotated[int, Field(ge=0, le=10**9)] = 0
    neighbours: tuple[Neighbour, ...] = ()
    scenario: dict[str, Any]


@dataclass(frozen=True, eq=False)
class Part:
    """The part of a scenario that one agent gets.

    Attributes:
        name: name of the scenario.
        run: name of the team's run on the network; messages of other runs are ignored.
        me: id of the agent.
        listen: address at which the agent listens.
        length: the team's unit of length.
        psi: the team's unit of ψ; see `consat.protocols.local.interior.Units`.
        center: (d,) centre of the team's region.
        reach: half width of the region on each axis, length; see `consat.problem.units.Region`.
        convex: whether every ψ of the team is proven concave.
        exact: whether the agents can prove bounds, because all used links form a tree; see
            `consat.protocols.local.interior.batches.Plan`.
        hops: largest number of links between two agents.
        team: a team of the agents whose positions this agent holds, in which only this agent has constraints.
        settings: protocol and smoothing.
        first: (copies, d) initial estimates of the positions that the agent holds, in the order of `team.ids`.
        absent: agents that are absent at the start and may join.
        neighbours: the neighbours, in the team's order.
        epoch: Unix time of t = 0, s; None if not set yet.
        generation: number of times the team has been split again since it started. Messages of other generations are ignored, because they
            may be exchanged along other links.
        extent: distance beyond `reach` to which constraints may lead, length; see `consat.problem.units.Scale`.
        robots: model of the agent's body, and the public map; None for a point.
    """

    name: str
    run: str
    me: str
    listen: str
    length: float
    psi: float
    center: np.ndarray
    reach: float
    convex: bool
    exact: bool
    hops: int
    team: Team
    settings: Settings
    first: np.ndarray
    absent: frozenset[str]
    neighbours: tuple[Neighbour, ...]
    epoch: float | None = None
    generation: int = 0
    extent: float = 0.0
    robots: Robots | None = None

    @property
    def own(self) -> int:
        """Row of the agent's own position."""
        return self.team.ids.index(self.me)

    @property
    def nu(self) -> Nu:
        """The smoothing, which is constant during a run, so that an agent that restarts has the same."""
        smoothing = self.settings.smoothing
        assert isinstance(smoothing, Smoothing)
        assert isinstance(smoothing.nu_beta, float)
        return Nu(smoothing.nu_alpha, smoothing.nu_beta)

    def problem(self, mode: str, sends: str = "all") -> bytes:
        """Hash (8 bytes) of the run, the mode, what is sent, and the common knowledge. It is the same for all agents of a run; no private
        data enters."""
        settings = self.settings.model_dump(mode="json", include={"protocol", "smoothing"})
        settings["protocol"]["kind"] = settings["protocol"]["kind"] or RUNS[mode]
        common = {
            "run": self.run, "mode": mode, "dimension": self.team.dimension, "length": self.length, "psi": self.psi,
            "hops": self.hops, "center": self.center.tolist(), "reach": self.reach, "extent": self.extent, "convex": self.convex,
            "exact": self.exact,
            "settings": settings,
        } | ({} if sends == "all" else {"sends": sends}) | ({"generation": self.generation} if self.generation else {})  # fmt: skip
        return hashlib.sha256(json.dumps(common, sort_keys=True).encode()).digest()[:8]

    def without(self, gone: Collection[str]) -> Part:
        """The part without some agents: without constraints that read their positions, copies of these, and links to the agents."""
        if not gone:
            return self
        present = np.array([agent not in gone for agent in self.team.ids])
        readable = [present[family.agents].all(axis=1) for family in self.team.families]
        neighbours = []
        for neighbour in self.neighbours:
            shares = tuple(agent for agent in neighbour.shares if agent not in gone)
            if shares and neighbour.id not in gone:
                known = dict(zip(neighbour.shares, neighbour.degrees, strict=True))
                kept_of = {
                    "shares": shares,
                    "degrees": tuple(known[agent] for agent in shares),
                    "travels": tuple(agent for agent in neighbour.travels if agent not in gone),
                }
                neighbours.append(neighbour.model_copy(update=kept_of))
        return replace(
            self,
            team=_sub_team(self.team, np.flatnonzero(present), readable),
            first=self.first[present],
            neighbours=tuple(neighbours),
        )


def _sub_team(team: Team, kept: np.ndarray, chosen: Sequence[np.ndarray]) -> Team:
    """Team of the agents `kept`, (n,), without starts, with the chosen constraints. `chosen`: (M_f,) a mask for each family."""
    place = np.full(team.count, -1, dtype=np.int32)
    place[kept] = np.arange(len(kept))
    pairs = [(family, np.flatnonzero(mask)) for family, mask in zip(team.families, chosen, strict=True) if mask.any()]
    numbers = np.sort(np.concatenate([np.zeros(0, dtype=np.int32), *(family.number[which] for family, which in pairs)]))
    families = [
        replace(
            family.members(which),
            agents=place[family.agents[which]],
            owner=place[family.owner[which]],
            number=np.searchsorted(numbers, family.number[which]).astype(np.int32),
        )
        for family, which in pairs
    ]
    bare = Team([Agent(team.ids[int(i)]) for i in kept], [], team.dimension)
    return bare.with_constraints(families, place[team.owner[numbers]], [team.names[int(number)] for number in numbers])


@float64
def split(
    scenario: Scenario,
    *,
    run: str | None = None,
    addresses: Mapping[str, str] | None = None,
    port: int = PORT,
    absent: Collection[str] = (),
    only: str | None = None,
    epoch: float | None = None,
    generation: int = 0,
) -> dict[str, Part]:
    """Split a scenario into parts. Returns a mapping from agent to part.

    The layout of the copies and the links along which they are exchanged suit the scenario's protocol, or the team's default protocol.

    Args:
        scenario: the scenario, whose protocol, seed and smoothing are those of the run.
        run: name of the run on the network; by default derived from the scenario's text, so that it is the same on every machine.
        addresses: agent to address, such as ``tcp/192.168.0.7:7447``; by default consecutive ports on this machine.
        port: port of the first agent.
        absent: agents that are absent at the start and may join.
        only: compute the part of this agent only.
        epoch: Unix time of t = 0, s.
        generation: see `Part`.

    Raises:
        InvalidTeam: a cluster is not connected by links.
        InvalidSettings: an agent that the team does not have, or no room for the ports.
    """
    from consat.certify.quadratics import shape_of
    from consat.problem.graphs import hops
    from consat.problem.objective import SmoothingSchedule
    from consat.problem.units import automatic, scale
    from consat.protocols.local.interior import Shared, Units
    from consat.runs.preparation import DEFAULT_PROTOCOL, copies_of, default_protocol, first_estimates

    team, settings = scenario.team, scenario.settings
    addresses = addresses or {}
    for named in (*addresses, *absent, *(() if only is None else (only,))):
        if named not in team.ids:
            raise InvalidSettings(f"there is no agent {named!r}{closest(named, team.ids)}")
    if not 1 <= port <= 65536 - team.count:
        raise InvalidSettings(f"port is {port}, but must leave room for {team.count} ports below 65536")
    copies, size = copies_of(team, settings.protocol), scale(team)
    schedule = SmoothingSchedule.of(automatic(size) if settings.smoothing == "auto" else settings.smoothing)
    default = default_protocol(team, settings.protocol.estimates)
    named = settings.protocol.kind or (None if default == DEFAULT_PROTOCOL else default)
    common = Settings(
        protocol=settings.protocol.model_copy(update={"kind": named}),
        smoothing=Smoothing(nu_alpha=float(schedule.final.alpha), nu_beta=float(schedule.final.beta)),
    )
    first, concave = first_estimates(team, copies, settings.start, size), shape_of(team).concave
    listen = [addresses.get(agent, f"tcp/127.0.0.1:{port + i}") for i, agent in enumerate(team.ids)]
    degree = np.bincount(copies.edges[:, 0], minlength=copies.count)
    run = run or f"{_word(scenario.name)}-{hashlib.sha256(scenario.text.encode()).hexdigest()[:12]}"
    across, unit = hops(team.count, copies.links), float(Units.of(size).psi)
    shared = Shared.of(copies)
    pair_of = {(int(here), int(there)): k for k, (here, there) in enumerate(shared.pairs)}
    rows_of = np.split(shared.row, np.searchsorted(shared.pair, np.arange(1, max(len(shared.pairs), 1))))
    parts = {}
    for owner, agent in enumerate(team.ids):
        if only is not None and agent != only:
            continue
        rows = np.flatnonzero(copies.holder == owner)
        ends = copies.edges[np.isin(copies.edges[:, 0], rows)]
        others = copies.holder[ends[:, 1]]
        own = _sub_team(team, copies.position[rows], [family.owner == owner for family in team.families])
        neighbours = []
        for other in np.unique(others):
            far, shares = ends[others == other, 1], rows_of[pair_of[owner, int(other)]]
            neighbours.append(
                Neighbour(
                    id=team.ids[other],
                    address=listen[other],
                    shares=tuple(team.ids[i] for i in copies.position[far]),
                    degrees=tuple(map(int, degree[far])),
                    travels=tuple(team.ids[i] for i in copies.position[shares[shares >= 0]]),
                    level=bool((shares < 0).any()),
                )
            )
        parts[agent] = Part(
            scenario.name, run, agent, listen[owner], size.length, unit, size.center, size.reach, bool(concave.all()), shared.exact, across,
            own, common, first[rows], frozenset(absent), tuple(neighbours),
            epoch, generation, size.extent, _robot(scenario.robots, agent),
        )  # fmt: skip
    return parts


def _robot(robots: Robots | None, agent: str) -> Robots | None:
    """The model of one agent's robot, and the map."""
    return None if robots is None else replace(robots, common=robots.own.get(agent, robots.common), own={})


def _word(name: str) -> str:
    return "".join(letter if letter.isascii() and letter.isalnum() else "-" for letter in name)[:40]


def write_part(part: Part) -> str:
    """Text of the private file of an agent.

    Raises:
        InvalidTeam: it has constraints that are Python functions, which a file cannot store.
    """
    scenario = read(dump(part.team, part.settings, part.name, robots=part.robots), part.me).root
    assert scenario is not None
    return write(
        {
            "consat-part": VERSION,
            "run": part.run,
            "agent": part.me,
            "listen": part.listen,
            "length": part.length,
            "psi": part.psi,
            "center": part.center.tolist(),
            "reach": part.reach,
            "extent": part.extent,
            "convex": part.convex,
            "exact": part.exact,
            "hops": part.hops,
            "first": {agent: row.tolist() for agent, row in zip(part.team.ids, part.first, strict=True)},
            "absent": sorted(part.absent),
            **({} if part.epoch is None else {"epoch": part.epoch}),
            **({"generation": part.generation} if part.generation else {}),
            "neighbours": [neighbour.model_dump(mode="json") for neighbour in part.neighbours],
            "scenario": scenario.plain,
        }
    )


def is_part(text: str, file: str) -> bool:
    """Whether a text is a part file (not a scenario). `file`: name of the file, for error messages."""
    root = read(text, file).root
    return root is not None and isinstance(root.value, dict) and "consat-part" in root.value


def load_text(file: Path) -> str:
    """Text of a file, with the size limit and the errors of `consat.scenario.load`."""
    with file.open("rb") as stream:
        return decode(stream.read(LARGEST + 1), str(file))


def read_part(text: str, file: str) -> Part:
    """Read a part from a text written by `write_part`. `file`: name of the file, for error messages.

    Raises:
        InvalidScenario: lists every fault with its line and column.
    """
    document = read(text, file)
    data = document.root.plain if document.root else None
    if not isinstance(data, dict) or "scenario" not in data or not isinstance(data["scenario"], dict):
        raise document.invalid([Fault((), "this is no part of a scenario; consat split writes them")])
    if data.get("consat-part") != VERSION:
        message = f"the version is {shown(data.get('consat-part'))}, but this consat reads {VERSION}; split the scenario again"
        raise document.invalid([Fault(("consat-part",), message)])
    try:
        frame = _File.model_validate(data)
    except ValidationError as error:
        raise document.invalid(_complaints(error, data)) from None
    if document.faults:
        raise document.invalid()
    assert document.root is not None
    team, settings, name, robots, _ = build(Document(file, document.root.value["scenario"]))
    if faults := list(_unfit(frame, team, settings)):
        raise document.invalid(faults)
    return Part(
        name or frame.agent, frame.run, frame.agent, frame.listen, frame.length, frame.psi, np.array(frame.center, dtype=float),
        frame.reach, frame.convex, frame.exact, frame.hops, team, settings,
        np.array([frame.first[agent] for agent in team.ids], dtype=float), frozenset(frame.absent), frame.neighbours, frame.epoch,
        frame.generation, frame.extent, robots,
    )  # fmt: skip


def _complaints(error: ValidationError, data: Any) -> list[Fault]:
    faults = []
    for item in error.errors(include_url=False):
        path = tuple(part for part in item["loc"] if part != "[key]")
        if item["type"] == "extra_forbidden":
            faults.append(Fault(path, f"there is no key {shown(path[-1])} in a part", offset=AT_KEY))
        elif item["type"] == "missing":
            faults.append(Fault(path[:-1], f"{path[-1]} is missing"))
        else:
            value = functools.reduce(lambda inner, key: inner[key], path, data)
            faults.append(Fault(path, f"it is {shown(value)}, but {_must(item['msg'])}"))
    return faults


def _must(message: str) -> str:
    """Rephrase an error message of Pydantic in the style of consat."""
    return message.removeprefix("Value error, ").replace("Input should", "must").replace("should", "must")


def _unfit(frame: _File, team: Team, settings: Settings) -> Iterator[Fault]:
    """Contradictions between the frame and the scenario inside."""
    if set(frame.first) != set(team.ids):
        yield Fault(("first",), f"first must have the agents of the scenario within, {', '.join(team.ids)}")
    if len(frame.center) != team.dimension:
        yield Fault(("center",), f"it has {counted(len(frame.center), 'number')}, but must have {team.dimension}, one for each dimension")
    for agent, row in frame.first.items():
        if len(row) != team.dimension:
            yield Fault(("first", agent), f"it has {counted(len(row), 'number')}, but must have {team.dimension}, one for each dimension")
    if frame.agent not in team.ids:
        yield Fault(("agent",), f"agent {frame.agent!r} is not among the agents of the scenario within")
    elif any(team.ids[owner] != frame.agent for owner in team.owner):
        yield Fault(("scenario", "agents"), f"an agent other than {frame.agent!r} has constraints, but a part holds only its agent's own")
    smoothing = settings.smoothing
    if not isinstance(smoothing, Smoothing) or not isinstance(smoothing.nu_beta, float):
        yield Fault(("scenario",), "smoothing must give nu_alpha and nu_beta as numbers, for all agents must have the same")
    yield from _unfit_neighbours(frame, team)


def _unfit_neighbours(frame: _File, team: Team) -> Iterator[Fault]:
    known: set[str] = {frame.agent}
    for k, neighbour in enumerate(frame.neighbours):
        path = ("neighbours", k)
        if neighbour.id in known:
            yield Fault((*path, "id"), f"{neighbour.id!r} is the agent itself or stands here for the second time; keep one")
        known.add(neighbour.id)
        if len(neighbour.degrees) != len(neighbour.shares):
            yield Fault((*path, "degrees"), f"it has {counted(len(neighbour.degrees), 'number')}, but must have one for each of shares")
        if unknown := [agent for agent in neighbour.shares if agent not in team.ids]:
            yield Fault((*path, "shares"), f"{unknown[0]!r} is not among the agents of the scenario within")
        elif sorted(neighbour.shares, key=team.ids.index) != list(dict.fromkeys(neighbour.shares)):
            yield Fault((*path, "shares"), "it must name each agent once, in the order of the scenario within")
        elif list(neighbour.travels) != [agent for agent in neighbour.shares if agent in neighbour.travels]:
            yield Fault((*path, "travels"), "it must name agents of shares, each once, in their order")
