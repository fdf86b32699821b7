"""Shows a session on a board: its scene, each round, and what is proven of its constraints."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from typing import Any, Final

import numpy as np

from consat.errors import ConsatError
from consat.numerics import float64
from consat.problem.team import Team
from consat.runs.session import Session, assessed
from consat.scenario.robots import Robots
from consat.server import frames
from consat.server.background import Background
from consat.server.board import Board
from consat.server.scene import Scene
from consat.server.targets import CENTERS, family_of

MOST_PATCHED: Final = 50
"""Most balls that are shown one by one. If more have changed, the scene is shown anew."""
MOST_FOLLOWED: Final = 3200
"""Most constraints of a team whose moving regions are shown while they move."""
MOST_ASSESSED: Final = 3000
"""Most constraints of a team that is assessed while it lives."""
PAUSE: Final = 0.1
"""Time between two updates of regions that move, s."""


class Display:
    """Writes what pages show of a session to a board. Verdicts and traced outlines are computed in the background.

    Args:
        session: the session to show at first.
        name: name of the scenario.
        robots: robots and obstacles; None if agents are points that move freely.
        notify: called when the board has news, from any thread.

    Attributes:
        board: the latest content of each topic.
        scene: the team as the page draws it.
        revision: number of changes of the team so far. A verdict belongs to one revision.
    """

    def __init__(self, session: Session, name: str, robots: Robots | None, notify: Callable[[], None]) -> None:
        self.board, self.revision = Board(), 0
        self._name, self._robots, self._notify = name, robots, notify
        self._told_at = 0.0
        self._patches: dict[int, dict[str, Any]] = {}
        self._walls: list[Any] | None = None
        self._assessor: Background[tuple[int, Team | None]] = Background(self._assess, 0.15, 1.0, "consat assessment")
        self._tracer: Background[tuple[Scene, Team, np.ndarray]] = Background(self._trace, 0.0, 0.0, "consat outlines")
        self.show_scene(session, Scene.of(1, session.team.at(session.time), session.positions, robots))

    def close(self) -> None:
        """End the work in the background."""
        self._assessor.close()
        self._tracer.close()

    def show(self, topic: str, content: Any) -> None:
        """Write the content of a topic: bytes, text, or data for JSON."""
        self.board.put(topic, content if isinstance(content, bytes | str) else json.dumps(content, separators=(",", ":"), allow_nan=False))
        self._notify()

    def restructure(self, session: Session) -> None:
        """Show the scene anew. It keeps its number if its agents and shapes are the same, so that a page goes on holding a shape."""
        old, scene = self.scene, Scene.of(self.scene.number + 1, session.team.at(session.time), session.positions, self._robots)
        same = (old.team.ids, old.shared) == (scene.team.ids, scene.shared)
        self.show_scene(session, scene._replace(number=old.number) if same else scene)

    def show_scene(self, session: Session, scene: Scene) -> None:
        """Show a scene in place of the present one."""
        self.scene, self._patches, self._walls = scene, {}, None
        self.board.drop("shapes", "outlines")
        self.show("scene", scene.text(self._name, self._robots))
        self._retrace(session)

    def reshape(self, session: Session, numbers: set[int]) -> None:
        """Show the present regions of some constraints, given by their indices in the team."""
        scene, team = self.scene, session.team.at(session.time)
        balls, walls = scene.shared
        hit = [k for k, own in enumerate(balls) if not numbers.isdisjoint(own)]
        if any(not numbers.issuperset(balls[k]) for k in hit) or len({*self._patches, *hit}) > MOST_PATCHED:
            self.restructure(session)
            return
        for k in hit:
            family, m = family_of(team, balls[k][0])
            given = {key: value[m] for key, value in family.parameters.items()}
            center = given.get(CENTERS.get(family.kind, ""), np.zeros(team.dimension))
            self._patches[k] = {"center": np.asarray(center).tolist(), "radius": float(given["radius"])}
        if any(not numbers.isdisjoint(own) for own in walls):
            moved = scene.moved(team)
            if moved is None:
                self.restructure(session)
                return
            self.scene, self._walls = moved, list(moved.told_walls())
        if self._patches or self._walls is not None:
            self.show("shapes", {"type": "shapes", "number": scene.number, "balls": self._patches, "walls": self._walls})
        if numbers & set(scene.shapes.others.tolist()):
            self._retrace(session)

    def show_round(self, session: Session) -> None:
        """Show the present round and, every `PAUSE`, the regions that move by themselves."""
        shown = (session.round, session.margin, session.positions, session.margins, session.headings)
        self.show("frame", frames.packed(self.scene.number, *shown))
        now, team = time.monotonic(), session.team
        if now - self._told_at <= PAUSE:
            return
        self._told_at = now
        if team.moves and len(team.owner) <= MOST_FOLLOWED:
            self.reshape(session, {int(number) for family in team.families if family.tracks for number in family.number})
            self._assessor.ask((self.revision, team.at(session.time)))
        elif len(self.scene.shapes.others):
            self._retrace(session)

    def reassess(self, session: Session) -> None:
        """Begin a new revision: the last verdict no longer holds."""
        self.revision += 1
        team = session.team
        self._assessor.ask((self.revision, team.at(session.time) if len(team.owner) <= MOST_ASSESSED else None))

    def _retrace(self, session: Session) -> None:
        if len(self.scene.shapes.others):
            self._tracer.ask((self.scene, session.team.at(session.time), session.positions))

    def _assess(self, asked: tuple[int, Team | None]) -> None:
        revision, team = asked
        message: dict[str, Any] = {"type": "verdict", "revision": revision, "verdict": "undecided", "bounds": [None, None], "reasons": []}
        if team is None:
            message["reasons"] = [f"a team of more than {MOST_ASSESSED:,} constraints is not assessed while it lives; use consat solve"]
        else:
            try:
                found = assessed(team)
            except ConsatError as error:
                message["reasons"] = [str(error)]
            else:
                message |= {"verdict": found.verdict, "bounds": list(found.bounds), "reasons": list(found.reasons)}
        self.show("verdict", message)

    def _trace(self, asked: tuple[Scene, Team, np.ndarray]) -> None:
        scene, team, x = asked
        found = float64(scene.traced)(team, x)
        if found is not None and scene.number == self.scene.number:
            self.show("outlines", found)
