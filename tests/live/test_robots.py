"""Robots on the live page: the sizes of their bodies, where they look, and what stands in their way."""

from __future__ import annotations

import json
import struct

import numpy as np

import consat as cs
from consat.robots.obstacles import box
from consat.server.simulation import Simulation


def test_page_knows_bodies_obstacles_and_headings() -> None:
    team = cs.Team([cs.Agent("a", [cs.within([0, 0], 1)], start=[0, 0]), cs.Agent("b", [cs.near("a", 1.5)], start=[1, 0])])
    robots = {"a": cs.Unicycle(radius=0.2, offset=0.05), "b": cs.Point(radius=0.1)}
    simulation = Simulation(team, robots=robots, obstacles=[cs.disc([3, 0], 0.5), box([-1, 3], [1, 4])])
    try:
        news = list(simulation.board.news({}))
    finally:
        simulation.close()
    [frame] = [each for each in news if isinstance(each, bytes)]
    [scene] = [told for each in news if isinstance(each, str) and (told := json.loads(each))["type"] == "scene"]
    assert scene["bodies"] == {"radius": [0.2, 0.1], "offset": [0.05, 0.0]}
    assert [each["kind"] for each in scene["obstacles"]] == ["disc", "box"]
    assert scene["high"][0] > 3.5  # the obstacles are in the picture
    assert scene["high"][1] > 4
    assert struct.unpack_from("<H", frame, 2) == (1,)  # headings follow
    assert len(np.frombuffer(frame, "<f4", offset=16)) == 2 * (2 + 1 + 1)
