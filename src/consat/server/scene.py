"""The static part of the live page: agents, links, regions, and the box to show."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any, Final, NamedTuple

import numpy as np

from consat.problem.team import Team
from consat.scenario.robots import Robots, obstacle_data
from consat.views import bodies, page_data
from consat.views.regions import MOST_TRACED, outlines
from consat.views.shapes import MOST_SHAPES, Shapes, moves, shapes

MOST_LISTED: Final = 2000
"""Most constraints that are listed on the page."""


class Scene(NamedTuple):
    """A team as the page draws it.

    Attributes:
        number: number of the scene, which frames repeat.
        team: the team, with its present constraints.
        shapes: geometry of the constraints.
        low: (p,) lower corner of the box to show, p at most 3.
        high: (p,) upper corner.
    """

    number: int
    team: Team
    shapes: Shapes
    low: np.ndarray
    high: np.ndarray

    @classmethod
    def of(cls, number: int, team: Team, x: np.ndarray, robots: Robots | None = None) -> Scene:
        """The scene of a team at positions x, (N, d)."""
        paths = x[None, :, :3]
        stand = None if robots is None or paths.shape[2] < 2 else bodies.bounds(robots.obstacles, paths.shape[2])
        low, high = page_data.frame(team, paths, stand=stand)
        drawn = team if len(team.owner) <= MOST_SHAPES else team.with_constraints([], team.owner[:0], ())
        return cls(number, team, shapes(drawn), low, high)

    @property
    def shared(self) -> tuple[list[list[int]], list[list[int]]]:
        """The indices of the constraints of each ball, and of each half-space."""
        return self.shapes.balls.numbers, self.shapes.walls.numbers

    def moved(self, team: Team) -> Scene | None:
        """The scene with the half-spaces of `team`; None if other constraints share them now."""
        scene = self._replace(team=team, shapes=shapes(team))
        return scene if scene.shared == self.shared else None

    def text(self, name: str, robots: Robots | None) -> str:
        """The scene as JSON."""
        team, listed = self.team, len(self.team.owner) <= MOST_LISTED
        sizes = None if robots is None else bodies.sizes(robots, team.ids)
        data = {
            "type": "scene",
            "number": self.number,
            "name": name,
            "unit": team.unit,
            "dimension": min(3, team.dimension),
            "ids": list(team.ids),
            "links": team.links.ravel().tolist(),
            "low": np.round(self.low, 6).tolist(),
            "high": np.round(self.high, 6).tolist(),
            "balls": self.told_balls(),
            "walls": self.told_walls(),
            "constraints": [[int(owner), name] for owner, name in zip(team.owner, team.names, strict=True)] if listed else [],
            "obstacles": [] if robots is None else [obstacle_data(each) for each in robots.obstacles],
            "bodies": None if sizes is None else {"radius": sizes[0].tolist(), "offset": sizes[1].tolist()},
        }
        return json.dumps(data, separators=(",", ":"), allow_nan=False)

    def told_balls(self) -> list[dict[str, Any]]:
        """The balls as plain data."""
        return page_data.balls_of(self.team, self.shapes.balls)

    def told_walls(self) -> list[Mapping[str, Any]]:
        """The half-spaces as plain data."""
        return page_data.walls_of(self.team, self.shapes.walls, self.low, self.high)

    def traced(self, team: Team, x: np.ndarray) -> str | None:
        """The boundaries of other ψ as JSON; None if there are none to trace."""
        numbers = self.shapes.others
        if team.dimension != 2 or not 0 < len(numbers) <= MOST_TRACED:
            return None
        ties = moves(team)[numbers]
        lines = outlines(team, numbers.tolist(), x, self.low, self.high)
        found = [
            {"at": [0], "lines": [[np.round(line, 4).ravel().tolist() for line in each]], "owners": [int(team.owner[k])], "ties": bool(tie)}
            for k, each, tie in zip(numbers.tolist(), lines, ties, strict=True)
        ]
        return json.dumps({"type": "outlines", "number": self.number, "outlines": found}, separators=(",", ":"), allow_nan=False)
