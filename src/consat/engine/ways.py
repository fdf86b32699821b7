"""Path planning around obstacles, on the host between chunks of rounds. A robot gets a new path when its target has moved, when it no
longer sees its next waypoint, or when it has waited too long."""

from __future__ import annotations

import numpy as np

from consat.engine.bodies import Driven
from consat.numerics import on_device
from consat.robots import Drive, Planner, disc
from consat.robots.obstacles import map_of

MOVED = 0.5
"""Distance by which a target must move for a new path, in multiples of the robot's size."""


WAITED = 1.0
"""Time without progress, s, after which a robot checks that it still sees its next waypoint: others may have pushed it behind a corner."""

DETOUR = 3.0
"""Time without progress, s, after which a robot in the plane looks for a path around standing robots near it; repeated at this interval."""
STANDS = 3.0
"""A robot counts as standing if its distance to its target is below this multiple of its tolerance; other robots may be pushing it."""


class Ways:
    """Path planner for the robots of a team. Each robot plans alone, on the public map.

    Args:
        drive: the robots.
        every: largest number of rounds between two calls of `planned`.
    """

    def __init__(self, drive: Drive, every: int) -> None:
        self._between = every * drive.dt
        self._drive = drive
        self._tolerance = MOVED * np.asarray(drive.size)
        self._planner = Planner(drive.map, float(np.max(drive.size)))

    def planned(self, robots: Driven, place: np.ndarray, targets: np.ndarray) -> Driven:
        """The robots with new paths where needed: where the target is no longer at the end of the path, where a waiting robot does not see
        its next waypoint, and where a waiting robot can detour around standing ones.

        Args:
            robots: the robots.
            place: (N, d) positions.
            targets: (N, d) targets.
        """
        assert robots.paths is not None
        paths = np.array(robots.paths)
        moved = np.linalg.norm(paths[:, -1] - targets, axis=1) > self._tolerance
        waited = np.asarray(robots.memory.waited)
        waiting = np.flatnonzero(~moved & (waited > WAITED))
        if len(waiting):
            ahead = paths[waiting, np.asarray(robots.memory.waypoint)[waiting]]
            moved[waiting] = ~self._planner.seen(place[waiting], ahead)
        found = {i: self._planner.path(place[i], targets[i]) for i in np.flatnonzero(moved).tolist()}
        if self._drive.dimension == 2:
            due = ~moved & (waited >= DETOUR) & (waited % DETOUR < self._between)
            found |= {i: path for i in np.flatnonzero(due).tolist() if (path := self._detour(i, place, targets)) is not None}
        if not found:
            return robots
        anew = np.array(list(found))
        width = max(paths.shape[1], 1 << max(max(map(len, found.values())) - 1, 0).bit_length())
        if width > paths.shape[1]:
            paths = np.concatenate([paths, np.repeat(paths[:, -1:], width - paths.shape[1], axis=1)], axis=1)
        for i, path in found.items():
            paths[i, : len(path)], paths[i, len(path) :] = path, path[-1]
        waypoint = np.array(robots.memory.waypoint)
        waypoint[anew] = 0
        memory = robots.memory._replace(waypoint=on_device(waypoint))
        return robots._replace(memory=memory, paths=on_device(paths))

    def _detour(self, i: int, place: np.ndarray, targets: np.ndarray) -> np.ndarray | None:
        """Path of robot i around the obstacles of the map and the standing robots in range; None without standing robots or such a path."""
        drive = self._drive
        stands = np.linalg.norm(targets - place, axis=1) < STANDS * np.asarray(drive.arrives)
        stands &= np.linalg.norm(place - place[i], axis=1) < drive.range
        stands[i] = False
        if not stands.any():
            return None
        bodies = [disc(place[j], float(drive.size[j])) for j in np.flatnonzero(stands)]
        planner = Planner(map_of([*drive.obstacles, *bodies], 2), float(np.max(drive.size)))
        path = planner.path(place[i], targets[i])
        return path if planner.seen(place[i][None], path[:1]).all() else None
