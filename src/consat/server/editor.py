"""Carries out the orders that change a session, and undoes them."""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, Final, NamedTuple

import numpy as np

from consat.errors import ConsatError, Fault, InvalidInput, InvalidTeam, shown
from consat.problem.agent import Agent
from consat.problem.changes import named
from consat.problem.team import Team
from consat.runs.preparation import robots_of
from consat.runs.session import Session
from consat.scenario import Scenario, dump
from consat.scenario.mappings import constraint
from consat.server import orders, targets
from consat.server.display import Display
from consat.server.orders import Order
from consat.server.silent import Silent
from consat.server.targets import Target, parameters_of

MOST_UNDONE: Final = 100

Gesture = tuple[int, int] | None
"""A client and its number of a gesture. The orders of a gesture are undone together."""


class Undo(NamedTuple):
    """How to undo an order.

    Attributes:
        key: the gesture and its subject. Further orders with the same key need no undo of their own. None if there is none.
        back: undoes the order.
        compiles: whether the rounds must be compiled again, which takes seconds.
    """

    key: tuple[Any, ...] | None
    back: Callable[[], None]
    compiles: bool


class Editor:
    """A session with the changes that pages can make.

    Args:
        scenario: team and settings.
        settings: arguments of the session; see `consat.Session`.
        notify: called when the board has news, from any thread.
        say_busy: called with what will take seconds, before it begins.

    Attributes:
        session: the session.
        display: shows the session.
        cold: whether the next round must be compiled.
        loss: share of the messages that are lost.
        silent: killed agents, by id.
        cut: links that were cut.
        undos: how to undo the last orders.
    """

    def __init__(
        self, scenario: Scenario, settings: Mapping[str, Any], notify: Callable[[], None], say_busy: Callable[[str], None]
    ) -> None:  # fmt: skip
        self._scenario, self._settings, self._say_busy = scenario, dict(settings), say_busy
        self.session = Session(scenario, **settings)
        self._robots = robots_of(settings.get("robots"), settings.get("obstacles"), scenario)
        self.display = Display(self.session, scenario.name, self._robots, notify)
        self.cold, self.loss = True, float(settings.get("loss", 0.0))
        self.silent: dict[str, Silent] = {}
        self.cut: list[tuple[str, str]] = []
        self.undos: list[Undo] = []
        self._begun = self._places()

    def do(self, order: Order, gesture: Gesture) -> None:
        """Carry out an order; orders that change nothing are ignored. Raises: ConsatError: it is not possible; nothing has changed."""
        match order:
            case orders.Put():
                before = self._places().get(order.agent)
                self.session.place(order.agent, order.position)
                self._remember(None if gesture is None else (*gesture, order.agent), lambda: self._put_all({order.agent: before}))
            case orders.Loss():
                self._lose(order.share)
            case orders.Protocol():
                protocol = self.session.protocol
                self._begin_anew(order.kind)
                self._remember(None, lambda: self._begin_anew(protocol), compiles=True)
            case orders.Plain(do="undo"):
                self._undo()
            case orders.Plain(do="restart"):
                places = self._places()
                self._put_all(self._begun)
                self._remember(None, lambda: self._put_all(places))
            case _:
                self._do_parameters(order, gesture)
                self._do_structure(order)

    def _do_parameters(self, order: Order, gesture: Gesture) -> None:
        scene = self.display.scene
        balls, walls = scene.shared
        match order:
            case orders.Change():
                numbers = named(self.session.team, order.agent, order.constraint)
                self._change([Target(order.agent, order.constraint, numbers)], order.parameters, gesture)
            case orders.Shape():
                self._require_scene(order.scene, order.shape, len(balls))
                self._change(*targets.ball(scene.team, balls[order.shape], order.center, order.radius), gesture)
            case orders.Wall():
                self._require_scene(order.scene, order.wall, len(walls))
                self._change(*targets.wall(self.session.team, walls[order.wall], order.offset), gesture)
            case _:
                pass

    def _do_structure(self, order: Order) -> None:
        session = self.session
        match order:
            case orders.AddConstraint():
                made = _made(order.constraint)
                self._structural("one more constraint", lambda: session.add_constraint(order.agent, made))
            case orders.RemoveConstraint():
                self._structural("one constraint less", lambda: session.remove_constraint(order.agent, order.constraint))
            case orders.Add():
                agent = Agent(order.agent, [_made(each) for each in order.constraints], order.position)
                self._structural(f"the team with {order.agent}", lambda: session.add(agent, order.links))
            case orders.OfAgent(do="remove"):
                self._structural(f"the team without {order.agent}", lambda: session.remove(order.agent))
            case orders.OfAgent(do="kill"):
                silent = Silent.of(session.team, order.agent, session.positions)
                self._structural(f"the team without {order.agent}", lambda: session.remove(order.agent))
                self.silent[order.agent] = silent
            case orders.OfAgent():
                self._revive(order.agent)
            case orders.OfLink(do="disconnect"):
                self._structural("cutting a link", lambda: session.disconnect(order.one, order.other))
                self.cut.append((order.one, order.other))
            case orders.OfLink():
                self._structural("laying a link", lambda: session.connect(order.one, order.other))
                self.cut = [pair for pair in self.cut if set(pair) != {order.one, order.other}]
            case _:
                pass

    def text(self) -> str:
        """The team as it is now, as the text of a scenario."""
        here, scenario = self._team_here(), self._scenario
        agents = [dataclasses.replace(each, start=x) for each, x in zip(here.agents, here.starts, strict=True)]
        team = Team(agents, here.links, here.dimension, unit=here.unit)
        return dump(team, scenario.settings, scenario.name, robots=self._robots, rate=scenario.rate)

    def _change(self, changed: list[Target], parameters: Mapping[str, Any], gesture: Gesture) -> None:
        """Change parameters of some constraints to the same values; of all or of none."""
        if not parameters:
            return
        team = self.session.team
        before = [(each, parameters_of(team, each.numbers, list(parameters))) for each in changed]
        done = 0
        try:
            for each in changed:
                self.session.change(each.agent, each.name, **parameters)
                done += 1
        except ConsatError:
            for each, old in before[:done]:
                self.session.change(each.agent, each.name, **old)
            raise
        numbers = {number for each in changed for number in each.numbers}
        self.display.reshape(self.session, numbers)

        def back() -> None:
            for each, old in before:
                self.session.change(each.agent, each.name, **old)
            now = {number for each in changed for number in named(self.session.team, each.agent, each.name)}
            self.display.reshape(self.session, now)

        self._remember(None if gesture is None else (*gesture, *sorted(numbers)), back)
        self.display.reassess(self.session)

    def _require_scene(self, scene: int, place: int, count: int) -> None:
        if scene != self.display.scene.number or place >= count:
            raise InvalidTeam([Fault((), "the team has changed since; take hold of it again", "shape")])

    def _places(self) -> dict[str, np.ndarray]:
        return dict(zip(self.session.team.ids, self.session.positions, strict=True))

    def _put_all(self, places: Mapping[str, Any]) -> None:
        there = set(self.session.team.ids)
        for agent, position in places.items():
            if agent in there:
                self.session.place(agent, position)

    def _revive(self, name: str) -> None:
        if name not in self.silent:
            killed = ", ".join(self.silent) or "none"
            raise InvalidTeam([Fault((), f"it was not killed, so it cannot be revived; killed are {killed}", f"agent {shown(name)}")])
        whole = self.silent[name].back_in(self.session.team)
        self._structural(f"the team with {name} again", lambda: self.session.become(whole))
        del self.silent[name]

    def _lose(self, share: float) -> None:
        before = self.loss

        def back() -> None:
            self.session.lose(before)
            self.loss = before

        self._say_busy("other rounds, with another loss")
        self.session.lose(share)
        self.loss, self.cold = share, True
        self._remember(None, back, compiles=True)

    def _begin_anew(self, kind: str) -> None:
        self._say_busy(f"beginning with {kind}")
        scenario = dataclasses.replace(self._scenario, team=self._team_here())
        self.session = Session(scenario, **self._settings | {"protocol": kind, "loss": self.loss})
        self._restructured()

    def _structural(self, what: str, act: Callable[[], Any]) -> None:
        """Carry out `act`, which changes the agents, constraints or links of the team, so that its rounds are compiled again."""
        self._say_busy(what)
        before, silent, cut = self._team_here(), dict(self.silent), list(self.cut)
        act()

        def back() -> None:
            self.session.become(before)
            self.silent, self.cut = silent, cut
            self._restructured()

        self._remember(None, back, compiles=True)
        self._restructured()

    def _restructured(self) -> None:
        self.cold = True
        self.display.restructure(self.session)
        self.display.reassess(self.session)

    def _team_here(self) -> Team:
        """The team, with the present positions as its starts."""
        team = copy.copy(self.session.team)
        team.starts = self.session.positions
        return team

    def _remember(self, key: tuple[Any, ...] | None, back: Callable[[], None], *, compiles: bool = False) -> None:
        if key is None or not self.undos or self.undos[-1].key != key:
            self.undos.append(Undo(key, back, compiles))
            del self.undos[:-MOST_UNDONE]

    def _undo(self) -> None:
        if not self.undos:
            raise InvalidTeam([Fault((), "there is nothing to undo", "undo")])
        last = self.undos.pop()
        if last.compiles:
            self._say_busy("the team as it was")
        last.back()
        self.display.reassess(self.session)


def _made(described: Mapping[str, Any]) -> Any:
    """A constraint from its mapping in an order. Raises: InvalidInput: it is none."""
    made, faults = constraint(described, "constraint")
    if faults:
        raise InvalidInput(faults)
    return made
