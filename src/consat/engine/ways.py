"""Ways round obstacles, planned on the host between chunks of rounds, by whose target has moved or who lost sight of its way."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from consat.engine.round import Driven
from consat.robots import Drive, Planner

MOVED = 0.5
"""Of a robot's size: a target that moved by so much wants another way."""


WAITED = 1.0
"""Who came no nearer for so long, s, looks whether it still sees where it goes: others may have pushed it behind a corner."""


class Ways:
    """Plans for the robots of a team; each by itself, from the public map.

    Args:
        drive: the robots.
    """

    def __init__(self, drive: Drive) -> None:
        self._tolerance = MOVED * np.asarray(drive.size)
        self._planner = Planner(drive.map, float(np.max(drive.size)))

    def planned(self, robots: Driven, place: np.ndarray, targets: np.ndarray) -> Driven:
        """With new ways, from (N, d) places to (N, d) targets, for robots whose targets are no longer where their ways end, and for those
        who wait without seeing the next waypoint."""
        assert robots.paths is not None
        paths = np.array(robots.paths)
        moved = np.linalg.norm(paths[:, -1] - targets, axis=1) > self._tolerance
        waiting = np.flatnonzero(~moved & (np.asarray(robots.memory.waited) > WAITED))
        if len(waiting):
            ahead = paths[waiting, np.asarray(robots.memory.waypoint)[waiting]]
            moved[waiting] = ~self._planner.seen(place[waiting], ahead)
        anew = np.flatnonzero(moved)
        if not len(anew):
            return robots
        found = [self._planner.path(place[i], targets[i]) for i in anew.tolist()]
        width = max(paths.shape[1], 1 << max(max(map(len, found)) - 1, 0).bit_length())
        if width > paths.shape[1]:
            paths = np.concatenate([paths, np.repeat(paths[:, -1:], width - paths.shape[1], axis=1)], axis=1)
        for i, path in zip(anew.tolist(), found, strict=True):
            paths[i, : len(path)], paths[i, len(path) :] = path, path[-1]
        waypoint = np.array(robots.memory.waypoint)
        waypoint[anew] = 0
        memory = robots.memory._replace(waypoint=jnp.asarray(waypoint))
        return robots._replace(memory=memory, paths=jnp.asarray(paths))
