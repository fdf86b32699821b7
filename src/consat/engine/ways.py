"""Ways round obstacles, planned on the host between chunks of rounds, by whose target has moved who lost sight of its way, or waits."""

from __future__ import annotations

import numpy as np

from consat.engine.round import Driven
from consat.numerics import on_device
from consat.robots import Drive, Planner, disc
from consat.robots.obstacles import map_of

MOVED = 0.5
"""Of a robot's size: a target that moved by so much wants another way."""


WAITED = 1.0
"""Who came no nearer for so long, s, looks whether it still sees where it goes: others may have pushed it behind a corner."""

DETOUR = 3.0
"""Who came no nearer for so long, s, and each time as long again, looks for a way round those who stand near it, in the plane."""
STANDS = 3.0
"""A robot stands that is nearer to its target than so many times its tolerance: others may be pushing it."""


class Ways:
    """Plans for the robots of a team; each by itself, from the public map.

    Args:
        drive: the robots.
        every: how many rounds pass between two plans, at most.
    """

    def __init__(self, drive: Drive, every: int) -> None:
        self._between = every * drive.dt
        self._drive = drive
        self._tolerance = MOVED * np.asarray(drive.size)
        self._planner = Planner(drive.map, float(np.max(drive.size)))

    def planned(self, robots: Driven, place: np.ndarray, targets: np.ndarray) -> Driven:
        """With new ways, from (N, d) places to (N, d) targets, for robots whose targets are no longer where their ways end, and for those
        who wait without seeing the next waypoint."""
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
        """A way of robot i past the map and those whom it sees stand; None where nobody does, or no way leads past them."""
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
