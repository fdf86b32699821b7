"""A session in a thread of its own: it steps at its pace, takes orders between two rounds, and shows the newest on a board."""

from __future__ import annotations

import copy
import dataclasses
import functools
import inspect
import json
import math
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any, Final, NamedTuple

import numpy as np

from consat.errors import ConsatError, Fault, InvalidInput, InvalidTeam, closest, shown
from consat.numerics import float64
from consat.problem.agent import Agent
from consat.problem.constraints import KINDS
from consat.problem.constraints.record import OWNER, Constraint, flatten
from consat.problem.team import Team
from consat.runs.preparation import robots_of, scenario_of
from consat.runs.session import Session, assessed
from consat.scenario import Scenario, dump
from consat.server import frames, orders
from consat.server.background import Background
from consat.server.board import Board
from consat.server.orders import Order
from consat.server.scene import CENTERS, Scene, named, parameters_of, place_of

SPEED: Final = 20.0
"""Rounds a second at first."""
FRAMES: Final = 60.0
"""Frames a second at most."""
MOST_PENDING, MOST_UNDONE = 256, 100
MOST_PATCHED, MOST_SHARED = 50, 64
"""Balls that are told one by one before the scene is told anew; owners of one that can be changed together."""
MOST_ASSESSED: Final = 3000
"""Constraints of a team that is assessed while it lives."""

Answer = Callable[[dict[str, Any]], None]


class Pending(NamedTuple):
    """An order, who gave it, and where its answer goes."""

    order: Order
    client: int
    answer: Answer


class Silent(NamedTuple):
    """An agent that was killed, with all that it takes to bring it back.

    Attributes:
        place: in the team.
        agent: with its constraints, where it was.
        readers: ids of others, each with a constraint that read its position.
        links: ids of those it could talk to.
    """

    place: int
    agent: Agent
    readers: list[tuple[str, Constraint]]
    links: list[str]


class Undo(NamedTuple):
    """How to undo an order.

    Attributes:
        key: of the gesture; an order of the same one needs no undo of its own.
        back: what to do.
        compiles: whether it takes seconds.
    """

    key: tuple[Any, ...] | None
    back: Callable[[], None]
    compiles: bool


class Simulation:
    """A team that is stepped and changed while people watch.

    Args:
        team: a `consat.Team`, a scenario, or the name of one.
        notify: called whenever the board has news, from other threads.
        settings: of the session, such as ``protocol`` and ``seed``; see `consat.Session`.

    Raises:
        ConsatError: as `consat.Session`.
    """

    def __init__(self, team: Team | Scenario | str, notify: Callable[[], None] = lambda: None, **settings: Any) -> None:
        self._scenario, self._settings, self.notify = scenario_of(team), settings, notify
        self._session = Session(self._scenario, **settings)
        self._robots = robots_of(settings.get("robots"), settings.get("obstacles"), self._scenario)
        self.board = Board()
        self._orders: deque[Pending] = deque()
        self._wake, self._open, self._watched = threading.Condition(), True, 0
        self._playing, self._speed, self._owed = True, SPEED, 0
        self._loss, self._protocol = float(settings.get("loss", 0.0)), self._kind()
        self._busy: str | None = None
        self._cold = True
        self._undos: list[Undo] = []
        self._silent: dict[str, Silent] = {}
        self._cut: list[tuple[str, str]] = []
        self._begun = dict(zip(self._session.team.ids, self._session.positions, strict=True))
        self._revision, self._scenes, self._told_at = 0, 0, 0.0
        self._patches: dict[int, dict[str, Any]] = {}
        self._walls: list[Any] | None = None
        self._assessor: Background[tuple[int, Team | None]] = Background(self._assess, 0.15, 1.0, "consat assessment")
        self._tracer: Background[tuple[Scene, Team, np.ndarray]] = Background(self._trace, 0.0, 0.0, "consat outlines")
        self._scene = self._show_scene(None)
        self._show_state()
        self._show_frame()
        self._changed()
        self._thread = threading.Thread(target=self._run, name="consat session", daemon=True)

    @property
    def name(self) -> str:
        """Of the scenario."""
        return self._scenario.name

    @property
    def alive(self) -> bool:
        """Whether it goes on."""
        return self._thread.is_alive()

    def start(self) -> None:
        """Begin to step."""
        self._thread.start()

    def close(self) -> None:
        """End, and wait for the thread."""
        with self._wake:
            self._open = False
            self._wake.notify()
        if self._thread.is_alive():
            self._thread.join(timeout=60.0)
        self._assessor.close()
        self._tracer.close()

    def watch(self, count: int) -> None:
        """Tell how many are watching; nobody's session stands still."""
        with self._wake:
            self._watched = count
            self._wake.notify()

    def ask(self, order: Order, client: int, answer: Answer) -> None:
        """Queue an order; its answer comes from another thread."""
        with self._wake:
            full = len(self._orders) >= MOST_PENDING
            if not full:
                self._orders.append(Pending(order, client, answer))
                self._wake.notify()
        if full:
            answer({"type": "answer", "id": order.id, "ok": False, "words": "too many orders wait already; send fewer"})

    # ---- the thread ---------------------------------------------------------------------------------------------------------------------

    def _run(self) -> None:
        due = time.monotonic()
        try:
            while True:
                with self._wake:
                    while self._open and not self._orders and (wait := self._wait(due)) > 0:
                        self._wake.wait(None if math.isinf(wait) else wait)
                    if not self._open:
                        return
                    pending, self._orders = list(self._orders), deque()
                self._carry_out(pending)
                now = time.monotonic()
                if self._owed or (self._playing and now >= due):
                    count = self._owed or max(1, round(self._speed / FRAMES))
                    self._owed = 0
                    self._step(count)
                    due = max(due + count / self._speed, now - 0.1)
                self._show_frame()
        finally:
            self._open = False
            self.notify()

    def _step(self, count: int) -> None:
        if self._cold:
            self._say_busy("compiling the rounds of the team")
        self._session.step(count)
        if self._cold:
            self._cold, self._busy = False, None
            self._show_state()

    def _wait(self, due: float) -> float:
        """Seconds until the next round is due."""
        if self._owed:
            return 0.0
        return due - time.monotonic() if self._playing and self._watched else math.inf

    def _carry_out(self, pending: list[Pending]) -> None:
        """Carry out orders; of those that replace each other at once only the last."""
        last = {self._place(each): k for k, each in enumerate(pending)}
        late: dict[tuple[Any, ...], list[Pending]] = {}
        for k, each in enumerate(pending):
            key = self._place(each)
            if key is not None and last[key] != k:
                late.setdefault(key, []).append(each)
                continue
            told = self._answered(each)
            for other in [*(late.pop(key, []) if key is not None else []), each]:
                other.answer(told | {"id": other.order.id})

    @staticmethod
    def _place(pending: Pending) -> tuple[Any, ...] | None:
        """What an order that replaces earlier ones is about."""
        match pending.order:
            case orders.Change() as order:
                return "change", pending.client, order.gesture, order.agent, order.constraint, tuple(sorted(order.parameters))
            case orders.Shape() as order:
                return "shape", pending.client, order.gesture, order.scene, order.shape, order.center is None, order.radius is None
            case orders.Wall() as order:
                return "wall", pending.client, order.gesture, order.scene, order.wall
            case orders.Put() as order:
                return "place", pending.client, order.gesture, order.agent
            case _:
                return None

    def _answered(self, pending: Pending) -> dict[str, Any]:
        try:
            found = self._do(pending.order, pending.client)
        except ConsatError as error:
            return {"type": "answer", "ok": False, "words": str(error)[:1000]}
        finally:
            if self._busy is not None:
                self._busy = None
                self._show_state()
        return {"type": "answer", "ok": True, "words": "", "revision": self._revision, **found}

    # ---- orders -------------------------------------------------------------------------------------------------------------------------

    def _do(self, order: Order, client: int) -> dict[str, Any]:
        """Carry out one order. Raises: ConsatError: it cannot be; nothing has changed."""
        if isinstance(order, orders.Plain) and order.do == "text":
            return {"text": self._text()}
        gesture = None if order.gesture is None else (client, order.gesture)
        self._do_constraint(order, gesture)
        self._do_team(order, gesture)
        self._do_run(order)
        self._show_state()
        return {}

    def _do_constraint(self, order: Order, gesture: tuple[int, int] | None) -> None:
        session = self._session
        match order:
            case orders.Change():
                numbers = named(session.team, order.agent, order.constraint)
                self._change([(order.agent, order.constraint, numbers)], order.parameters, gesture)
            case orders.Shape():
                self._change_shape(order, gesture)
            case orders.Wall():
                self._change_wall(order, gesture)
            case orders.AddConstraint():
                made = _made(order.constraint)
                self._structural("one more constraint", lambda: session.add_constraint(order.agent, made))
            case orders.RemoveConstraint():
                self._structural("one constraint less", lambda: session.remove_constraint(order.agent, order.constraint))
            case _:
                pass

    def _do_team(self, order: Order, gesture: tuple[int, int] | None) -> None:
        session = self._session
        match order:
            case orders.Put():
                self._put(order.agent, order.position, gesture)
            case orders.Add():
                agent = Agent(order.agent, [_made(each) for each in order.constraints], order.position)
                self._structural(f"the team with {order.agent}", lambda: session.add(agent, order.links))
            case orders.OfAgent(do="remove"):
                self._structural(f"the team without {order.agent}", lambda: session.remove(order.agent))
            case orders.OfAgent(do="kill"):
                self._kill(order.agent)
            case orders.OfAgent():
                self._revive(order.agent)
            case orders.OfLink(do="disconnect"):
                self._structural("cutting a link", lambda: session.disconnect(order.one, order.other))
                self._cut.append((order.one, order.other))
            case orders.OfLink():
                self._structural("laying a link", lambda: session.connect(order.one, order.other))
                self._cut = [pair for pair in self._cut if set(pair) != {order.one, order.other}]
            case _:
                pass

    def _do_run(self, order: Order) -> None:
        match order:
            case orders.Step():
                self._owed += order.rounds
            case orders.Speed():
                self._speed = order.rounds
            case orders.Loss():
                self._lose(order.share)
            case orders.Protocol():
                self._follow(order.kind)
            case orders.Plain():
                self._plain(order.do)
            case _:
                pass

    def _plain(self, word: str) -> None:
        match word:
            case "play" | "pause":
                self._playing = word == "play"
            case "undo":
                self._undo()
            case "restart":
                before = self._places()
                self._put_all(self._begun)
                self._remember(None, lambda: self._put_all(before))
            case _:
                pass

    def _change(
        self, targets: list[tuple[str, str, list[int]]], parameters: Mapping[str, Any], gesture: tuple[int, int] | None
    ) -> None:  # fmt: skip
        """Change parameters of constraints that are all alike."""
        team = self._session.team
        before = [(agent, name, parameters_of(team, numbers, list(parameters))) for agent, name, numbers in targets]
        done = 0
        try:
            for agent, name, _ in targets:
                self._session.change(agent, name, **parameters)
                done += 1
        except ConsatError:
            for agent, name, old in before[:done]:
                self._session.change(agent, name, **old)
            raise
        numbers = {number for *_, own in targets for number in own}
        self._reshaped(numbers)

        def back() -> None:
            for agent, name, old in before:
                self._session.change(agent, name, **old)
            self._reshaped({number for agent, name, _ in before for number in named(self._session.team, agent, name)})

        self._remember(None if gesture is None else (*gesture, *sorted(numbers)), back)
        self._changed()

    def _change_shape(self, order: orders.Shape, gesture: tuple[int, int] | None) -> None:
        self._require_scene(order.scene, order.shape, len(self._scene.balls))
        numbers = self._scene.balls[order.shape]
        family, _ = place_of(self._scene.team, numbers[0])
        parameters: dict[str, Any] = {} if order.radius is None else {"radius": order.radius}
        if order.center is not None:
            if family.kind not in CENTERS:
                raise InvalidTeam([Fault((), f"{family.kind} has no centre of its own; change its radius", "shape")])
            parameters[CENTERS[family.kind]] = order.center
        if parameters:
            self._change(self._targets(numbers), parameters, gesture)

    def _change_wall(self, order: orders.Wall, gesture: tuple[int, int] | None) -> None:
        self._require_scene(order.scene, order.wall, len(self._scene.walls))
        numbers, team = self._scene.walls[order.wall], self._session.team
        family, k = place_of(team, numbers[0])
        given = {key: value[k] for key, value in family.parameters.items()}
        if "normal" in given:
            self._change(self._targets(numbers), {"offset": order.offset * float(np.linalg.norm(given["normal"]))}, gesture)
            return
        side, sign = ("high", 1.0) if "high" in given else ("low", -1.0)
        corner = np.where(np.asarray(given["axis"]) > 0, sign * order.offset, 0.0)
        targets = [(agent, name.rpartition(f".{side}[")[0], own) for agent, name, own in self._targets(numbers)]
        first = parameters_of(team, named(team, *targets[0][:2]), [side])[side]
        self._change(targets, {side: np.where(np.asarray(given["axis"]) > 0, corner, first).tolist()}, gesture)

    def _targets(self, numbers: list[int]) -> list[tuple[str, str, list[int]]]:
        team = self._session.team
        if len(numbers) > MOST_SHARED:
            message = f"{len(numbers)} agents share it, but at most {MOST_SHARED} can be changed together while the team lives"
            raise InvalidTeam([Fault((), message, "shape")])
        return [(team.ids[team.owner[number]], team.names[number], [number]) for number in numbers]

    def _require_scene(self, scene: int, place: int, count: int) -> None:
        if scene != self._scene.number or place >= count:
            raise InvalidTeam([Fault((), "the team has changed since; take hold of it again", "shape")])

    def _put(self, agent: str, position: Any, gesture: tuple[int, int] | None) -> None:
        before = self._places().get(agent)
        self._session.place(agent, position)
        self._remember(None if gesture is None else (*gesture, agent), lambda: self._put_all({agent: before}))

    def _put_all(self, places: Mapping[str, Any]) -> None:
        there = set(self._session.team.ids)
        for agent, position in places.items():
            if agent in there:
                self._session.place(agent, position)

    def _places(self) -> dict[str, np.ndarray]:
        return dict(zip(self._session.team.ids, self._session.positions, strict=True))

    def _kill(self, name: str) -> None:
        team = self._session.team
        place = self._places()
        if name not in place:
            raise InvalidTeam([Fault((), f"there is no such agent in the team{closest(name, team.ids)}", f"agent {shown(name)}")])
        own = {each.id: each for each in team.agents}
        readers = [
            (other, constraint)
            for other, each in own.items()
            if other != name
            for constraint in flatten(each.constraints)
            if name in constraint.reads
        ]
        links = [next(end for end in pair if end != name) for pair in team.linked if name in pair]
        silent = Silent(list(own).index(name), dataclasses.replace(own[name], start=place[name]), readers, links)
        self._structural(f"the team without {name}", lambda: self._session.remove(name))
        self._silent[name] = silent

    def _revive(self, name: str) -> None:
        silent = self._silent.get(name)
        if silent is None:
            killed = ", ".join(self._silent) or "none"
            raise InvalidTeam([Fault((), f"it was not killed, so it cannot be revived; killed are {killed}", f"agent {shown(name)}")])
        team = self._session.team
        there = {*team.ids, name}

        def fits(constraint: Constraint) -> bool:
            return all(read == OWNER or read in there for read in constraint.reads)

        agents = []
        for each in team.agents:
            back = [constraint for other, constraint in silent.readers if other == each.id and fits(constraint)]
            agents.append(dataclasses.replace(each, constraints=[*flatten(each.constraints), *back]) if back else each)
        own = [constraint for constraint in flatten(silent.agent.constraints) if fits(constraint)]
        links = [*team.linked, *((name, other) for other in silent.links if other in there)]
        agents.insert(silent.place, dataclasses.replace(silent.agent, constraints=own))
        whole = Team(agents, links, team.dimension, unit=team.unit)
        self._structural(f"the team with {name} again", lambda: self._session.become(whole))
        del self._silent[name]

    def _lose(self, share: float) -> None:
        before = self._loss
        self._say_busy("other rounds, with another loss")
        self._session.lose(share)
        self._loss, self._cold = share, True

        def back() -> None:
            self._session.lose(before)
            self._loss = before

        self._remember(None, back, compiles=True)

    def _follow(self, kind: str) -> None:
        before = self._protocol
        self._begin_anew(kind)
        self._remember(None, lambda: self._begin_anew(before), compiles=True)

    def _begin_anew(self, kind: str) -> None:
        self._say_busy(f"beginning with {kind}")
        scenario = dataclasses.replace(self._scenario, team=self._team_here())
        self._session = Session(scenario, **self._settings | {"protocol": kind, "loss": self._loss})
        self._protocol = self._kind()
        self._restructured()

    def _kind(self) -> str:
        return self._session.protocol

    def _structural(self, what: str, act: Callable[[], Any]) -> None:
        """Change who is in the team, or what they are to do; that compiles."""
        self._say_busy(what)
        before, silent, cut = self._team_here(), dict(self._silent), list(self._cut)
        act()

        def back() -> None:
            self._session.become(before)
            self._silent, self._cut = silent, cut
            self._restructured()

        self._remember(None, back, compiles=True)
        self._restructured()

    def _restructured(self) -> None:
        self._cold = True
        self._scene = self._show_scene(self._scene)
        self._changed()

    def _team_here(self) -> Team:
        """The team as it is, each agent with its position as its start."""
        team = copy.copy(self._session.team)
        team.starts = self._session.positions
        return team

    def _text(self) -> str:
        here = self._team_here()
        team = Team([dataclasses.replace(each, start=x) for each, x in zip(here.agents, here.starts, strict=True)], here.links,
                    here.dimension, unit=here.unit)  # fmt: skip
        scenario = self._scenario
        return dump(team, scenario.settings, scenario.name, robots=self._robots, rate=scenario.rate)

    def _remember(self, key: tuple[Any, ...] | None, back: Callable[[], None], *, compiles: bool = False) -> None:
        if key is None or not self._undos or self._undos[-1].key != key:
            self._undos.append(Undo(key, back, compiles))
            del self._undos[:-MOST_UNDONE]

    def _undo(self) -> None:
        if not self._undos:
            raise InvalidTeam([Fault((), "there is nothing to undo", "undo")])
        last = self._undos.pop()
        count = len(self._undos)
        if last.compiles:
            self._say_busy("the team as it was")
        last.back()
        del self._undos[count:]
        self._changed()

    # ---- showing ------------------------------------------------------------------------------------------------------------------------

    def _show(self, topic: str, content: Any) -> None:
        self.board.put(topic, content if isinstance(content, bytes | str) else json.dumps(content, separators=(",", ":"), allow_nan=False))
        self.notify()

    def _show_scene(self, old: Scene | None) -> Scene:
        session = self._session
        scene = Scene.of(self._scenes + 1, session.team.at(session.time), session.positions, self._robots)
        if old is not None and (old.team.ids, old.balls, old.walls) == (scene.team.ids, scene.balls, scene.walls):
            scene = scene._replace(number=old.number)  # who holds a region of it goes on holding it
        self._scenes, self._patches, self._walls = scene.number, {}, None
        self.board.drop("shapes", "outlines")
        self._show("scene", scene.text(self.name, self._robots))
        self._retrace(scene)
        return scene

    def _reshaped(self, numbers: set[int]) -> None:
        """Tell where the regions of some constraints are now."""
        scene, session = self._scene, self._session
        hit = [k for k, own in enumerate(scene.balls) if not numbers.isdisjoint(own)]
        if any(not numbers.issuperset(scene.balls[k]) for k in hit) or len({*self._patches, *hit}) > MOST_PATCHED:
            self._scene = self._show_scene(scene)
            return
        team = session.team.at(session.time)
        for k in hit:
            family, m = place_of(team, scene.balls[k][0])
            given = {key: value[m] for key, value in family.parameters.items()}
            center = given.get(CENTERS.get(family.kind, ""), np.zeros(team.dimension))
            self._patches[k] = {"center": np.asarray(center).tolist(), "radius": float(given["radius"])}
        if any(not numbers.isdisjoint(own) for own in scene.walls):
            moved = scene.moved(team)
            if moved is None:
                self._scene = self._show_scene(scene)
                return
            self._scene, self._walls = moved, list(moved.told_walls())
        if self._patches or self._walls is not None:
            self._show("shapes", {"type": "shapes", "number": scene.number, "balls": self._patches, "walls": self._walls})
        if numbers & set(scene.shapes.others.tolist()):
            self._retrace(scene)

    def _retrace(self, scene: Scene) -> None:
        if len(scene.shapes.others):
            self._tracer.ask((scene, self._session.team.at(self._session.time), self._session.positions))

    def _show_frame(self) -> None:
        session, now = self._session, time.monotonic()
        shown = (session.round, session.margin, session.positions, session.margins, session.headings)
        self._show("frame", frames.packed(self._scene.number, *shown))
        if now - self._told_at > 0.1:
            self._told_at = now
            team = session.team
            if team.moves and len(team.owner) <= MOST_SHARED * MOST_PATCHED:
                self._reshaped({int(number) for family in team.families if family.tracks for number in family.number})
                self._assessor.ask((self._revision, team.at(session.time)))
            elif len(self._scene.shapes.others):
                self._retrace(self._scene)

    def _show_state(self) -> None:
        session = self._session
        self._show("state", {
            "type": "state", "revision": self._revision, "playing": self._playing, "speed": self._speed, "loss": self._loss,
            "protocol": self._protocol,
            "rate": session.rate, "undo": len(self._undos), "busy": self._busy, "cut": self._cut,
            "silent": {name: np.asarray(each.agent.start)[:3].tolist() for name, each in self._silent.items()},
        })  # fmt: skip

    def _say_busy(self, what: str) -> None:
        self._busy = what
        self._show_state()

    def _changed(self) -> None:
        """What was proven holds no more."""
        self._revision += 1
        self._show_state()
        team = self._session.team
        self._assessor.ask((self._revision, team.at(self._session.time) if len(team.owner) <= MOST_ASSESSED else None))

    def _assess(self, asked: tuple[int, Team | None]) -> None:
        revision, team = asked
        told: dict[str, Any] = {"type": "verdict", "revision": revision, "verdict": "undecided", "bounds": [None, None], "reasons": []}
        if team is None:
            told["reasons"] = [f"a team of more than {MOST_ASSESSED:,} constraints is not assessed while it lives; use consat solve"]
        else:
            try:
                found = assessed(team)
            except ConsatError as error:
                told["reasons"] = [str(error)]
            else:
                told |= {"verdict": found.verdict, "bounds": list(found.bounds), "reasons": list(found.reasons)}
        self._show("verdict", told)

    def _trace(self, asked: tuple[Scene, Team, np.ndarray]) -> None:
        scene, team, x = asked
        found = float64(scene.traced)(team, x)
        if found is not None and scene.number == self._scenes:
            self._show("outlines", found)


def _made(described: Mapping[str, Any]) -> Any:
    """A constraint as a scenario file has it, made. Raises: ConsatError: it is none."""
    given = dict(described)
    kind = given.pop("kind", None)
    if not isinstance(kind, str) or kind not in KINDS:
        message = f"there is no kind {shown(kind)}{closest(kind, KINDS)}; the kinds are {', '.join(KINDS)}"
        raise InvalidInput([Fault(("kind",), message, "constraint")])
    keys = _keys(kind)
    if unknown := [key for key in given if key not in keys]:
        message = f"{kind} has no {unknown[0]!r}{closest(unknown[0], keys)}; it has {', '.join(keys)}"
        raise InvalidInput([Fault((unknown[0],), message, kind)])
    if missing := [key for key, each in keys.items() if each.default is each.empty and key not in given]:
        raise InvalidInput([Fault((missing[0],), f"{missing[0]} is missing; {kind} needs it", kind)])
    for key in ("agent", "name", "psi"):
        if key in given and not isinstance(given[key], str):
            raise InvalidInput([Fault((key,), f"{key} is {shown(given[key])}, but must be text", kind)])
    return KINDS[kind](**given)


@functools.cache
def _keys(kind: str) -> Mapping[str, inspect.Parameter]:
    return inspect.signature(KINDS[kind]).parameters
