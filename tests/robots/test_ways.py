"""Ways round obstacles while the team drives: planned again for whose target has moved, and for whom others have pushed behind a corner."""

import itertools

import jax.numpy as jnp
import numpy as np
import pytest

from consat.engine.bodies import Driven
from consat.engine.ways import DETOUR, WAITED, Ways
from consat.robots import Drive, Planner, Point, box

STARTS, GOALS = np.array([[-1.0, 0.0], [-1.0, 5.0]]), np.array([[1.0, 0.0], [1.0, 5.0]])


@pytest.fixture(scope="module")
def drive() -> Drive:
    return Drive(Point(), 2, 2, 0.05, [box([-0.2, -2.0], [0.2, 1.0])])


def waiting(drive: Drive, robots: Driven, seconds: float, waypoint: int) -> Driven:
    memory = robots.memory._replace(waited=jnp.full(2, seconds), waypoint=jnp.full(2, waypoint, dtype=jnp.int64))
    return robots._replace(memory=memory)


def test_who_waits_without_seeing_the_next_waypoint_plans_anew(drive: Drive) -> None:
    ways, state = Ways(drive, 10), drive.model.start(jnp.asarray(STARTS))
    begun = Driven(state, drive.start(state), jnp.repeat(jnp.asarray(STARTS)[:, None], 4, axis=1))
    planned = ways.planned(begun, STARTS, GOALS)
    assert planned.paths is not None
    above = np.asarray(planned.paths[0, 0])
    assert above[1] > 1.0, "round the nearer end"
    assert ways.planned(waiting(drive, planned, 2 * WAITED, 0), STARTS, GOALS).paths is planned.paths
    last = planned.paths.shape[1] - 1
    pushed = waiting(drive, planned, 0.5 * WAITED, last)
    assert ways.planned(pushed, STARTS, GOALS) is pushed, "it may be a moment only"
    pushed = waiting(drive, planned, 2 * WAITED, last)
    again = ways.planned(pushed, np.array([[-0.5, -1.9], [-1.0, 5.0]]), GOALS)
    assert again.paths is not None
    assert float(again.paths[0, 0, 1]) < -2.0, "from where it is now the other end is nearer"
    assert np.asarray(again.memory.waypoint).tolist() == [0, last], "who sees its way keeps it"


def test_a_robot_that_touches_a_wall_with_what_it_keeps_finds_its_way(drive: Drive) -> None:
    planner = Planner(drive.map, float(drive.size.max()))
    beside = np.array([-0.2 - float(drive.size.max()), 0.5])
    path = planner.path(beside, GOALS[0])
    assert len(path) > 1
    assert path[0, 1] >= 1.0
    assert planner.seen(beside[None], path[:1]).all()


def test_who_waits_for_long_goes_round_those_who_stand(drive: Drive) -> None:
    """The other one has arrived beside the corner, where the first way leads."""
    ways, state = Ways(drive, 10), drive.model.start(jnp.asarray(STARTS))
    begun = Driven(state, drive.start(state), jnp.repeat(jnp.asarray(STARTS)[:, None], 4, axis=1))
    corner = np.asarray(ways.planned(begun, STARTS, GOALS).paths[0, 0])  # type: ignore[index]
    place = corner[None] + np.array([[-0.3, -0.3], [0.0, 0.15]])
    targets = np.array([GOALS[0], place[1]])
    planned = ways.planned(begun, place, targets)
    assert ways.planned(waiting(drive, planned, DETOUR - 0.2, 0), place, targets).paths is planned.paths
    again = ways.planned(waiting(drive, planned, DETOUR + 0.2, 0), place, targets)
    path = np.concatenate([place[:1], np.asarray(again.paths[0])])  # type: ignore[index]
    points = np.concatenate([a + np.linspace(0, 1, 50)[:, None] * (b - a) for a, b in itertools.pairwise(path)])
    sizes = drive.size.sum()
    assert np.linalg.norm(points - place[1], axis=1).min() >= 0.99 * sizes
    assert float(jnp.min(drive.map.signed_distance(jnp.asarray(points)))) >= 0.99 * drive.size[0]
    np.testing.assert_array_equal(again.paths[1, 0], place[1])  # type: ignore[index]
