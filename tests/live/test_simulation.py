"""Orders about walls and shared regions, on a session that does not step."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

import consat as cs
from consat.errors import InvalidTeam
from consat.server import orders
from consat.server.simulation import Simulation
from consat.server.targets import parameters_of


@pytest.fixture(scope="module")
def simulation() -> Iterator[Simulation]:
    bar = cs.outside([9, 9], 1, name="bar")
    left = cs.Agent("left", [cs.halfspace([2, 0], 4, name="wall"), bar], [-1, 0])
    right = cs.Agent("right", [cs.box([0, -1], [3, 1]), bar, cs.near("left", 5)], [1, 0])
    found = Simulation(cs.Team([left, right]))
    yield found
    found.close()


def of(simulation: Simulation, agent: str, constraint: str, key: str) -> list[float]:
    team = simulation._editor.session.team
    owner = list(team.ids).index(agent)
    numbers = [k for k in np.flatnonzero(team.owner == owner) if team.names[k] == constraint]
    found: list[float] = np.asarray(parameters_of(team, numbers, [key])[key]).ravel().tolist()
    return found


def wall(simulation: Simulation, constraint: str, offset: float) -> None:
    team = simulation._display.scene.team
    k = next(k for k, own in enumerate(simulation._display.scene.shared[1]) if team.names[own[0]] == constraint)
    simulation._do(orders.Wall(do="wall", scene=simulation._display.scene.number, wall=k, offset=offset), 0)


def test_half_space_is_moved_along_its_normal(simulation: Simulation) -> None:
    wall(simulation, "wall", 3.0)
    assert of(simulation, "left", "wall", "offset") == [6.0]  # the normal has length 2
    simulation._do(orders.Plain(do="undo"), 0)
    assert of(simulation, "left", "wall", "offset") == [4.0]


@pytest.mark.parametrize(
    ("side", "offset", "low", "high"),
    [("box.low[0]", 0.5, [-0.5, -1], [3, 1]), ("box.high[1]", 2.0, [0, -1], [3, 2]), ("box.low[1]", 4.0, [0, -4], [3, 1])],
)
def test_sides_of_a_box_are_moved(simulation: Simulation, side: str, offset: float, low: list[float], high: list[float]) -> None:
    scene = simulation._display.scene.number
    wall(simulation, side, offset)
    assert simulation._display.scene.number == scene  # who holds a side goes on holding it
    for axis in (0, 1):
        assert of(simulation, "right", f"box.low[{axis}]", "low") == low
        assert of(simulation, "right", f"box.high[{axis}]", "high") == high
    simulation._do(orders.Plain(do="undo"), 0)
    assert of(simulation, "right", "box.low[0]", "low") == [0, -1]


def test_side_beyond_the_other_is_refused(simulation: Simulation) -> None:
    with pytest.raises(InvalidTeam, match="high"):
        wall(simulation, "box.low[0]", -3.5)
    assert of(simulation, "right", "box.low[0]", "low") == [0, -1]


def test_shared_region_moves_for_all_whose_it_is(simulation: Simulation) -> None:
    k = next(k for k, own in enumerate(simulation._display.scene.shared[0]) if len(own) == 2)
    simulation._do(orders.Shape(do="shape", scene=simulation._display.scene.number, shape=k, center=[8, 8], radius=2), 0)
    for agent in ("left", "right"):
        assert of(simulation, agent, "bar", "center") == [8, 8]
        assert of(simulation, agent, "bar", "radius") == [2]
    with pytest.raises(InvalidTeam, match="radius"):
        simulation._do(orders.Shape(do="shape", scene=simulation._display.scene.number, shape=k, radius=-1), 0)
    simulation._do(orders.Change(do="change", agent="left", constraint="bar", parameters={"radius": 1.5}), 0)
    assert len([own for own in simulation._display.scene.shared[0] if len(own) == 1]) == 3  # it is shared no more
    simulation._do(orders.Plain(do="undo"), 0)
    simulation._do(orders.Plain(do="undo"), 0)
    assert of(simulation, "right", "bar", "center") == [9, 9]


def test_what_has_no_middle_is_not_moved(simulation: Simulation) -> None:
    near = next(k for k, ball in enumerate(simulation._display.scene.told_balls()) if ball["names"] == ["near(left)"])
    with pytest.raises(InvalidTeam, match="near has no centre of its own"):
        simulation._do(orders.Shape(do="shape", scene=simulation._display.scene.number, shape=near, center=[8, 8]), 0)
