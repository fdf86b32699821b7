"""Teams on their way: everybody arrives, nobody touches, and what happened is said."""

import functools
import itertools
import re
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import shapely

import consat.errors
from consat.numerics import quick_compilation
from consat.robots import Double, Drive, Planner, Point, Quadrotor, Unicycle, box, disc, polygon
from consat.robots.neighbours import candidates, near
from consat.robots.obstacles import map_of

DT = 0.05
HORSESHOE = [[-1, -1], [1.2, -1], [1.2, 1], [-1, 1], [-1, 0.8], [1, 0.8], [1, -0.8], [-1, -0.8]]


@functools.cache
def run_of(drive: Drive, steps: int) -> Any:
    """So many steps and what came of them, as one program."""

    @functools.partial(jax.jit, compiler_options=quick_compilation())
    def run(starts: Any, targets: Any, paths: Any) -> Any:
        def body(carry: Any, _: None) -> Any:
            return drive.step(*carry, targets, paths=paths)[:2], None

        state = drive.model.start(starts)
        state, memory = jax.lax.scan(body, (state, drive.start(state)), length=steps)[0]
        return state, drive.observed(state, memory)

    return run


def driven(drive: Drive, starts: Any, goals: Any, until: float, paths: Any = None) -> tuple[Any, Any]:
    """State and memory after so many seconds."""
    return run_of(drive, round(until / drive.dt))(jnp.asarray(starts), jnp.asarray(goals), paths)  # type: ignore[no-any-return]


def circle(count: int, radius: float) -> np.ndarray:
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)
    return radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)


@pytest.mark.parametrize("model", [Point(), Double(), Unicycle()], ids=["points", "double", "unicycles"])
def test_ten_robots_swap_places_through_one_middle(model: Any) -> None:
    starts = circle(10, 1.6)
    drive = Drive(model, 10, 2, DT)
    state, memory = driven(drive, starts, -starts, until=25.0)
    assert bool(jnp.all(drive.arrived(state, jnp.asarray(-starts))))
    assert drive.stuck(state, memory, jnp.asarray(-starts)) == []
    assert int(memory.report.contacts) == 0
    assert float(memory.report.smallest_distance) >= 0.0
    assert float(memory.report.strayed) <= 1e-12


def test_bodies_that_overlap_are_counted_as_one_contact_a_pair_and_part() -> None:
    starts = np.array([[0.0, 0.0], [0.15, 0.0], [2.0, 0.0]])
    goals = np.array([[-1.0, 0.0], [1.0, 0.0], [2.0, 0.0]])
    state, memory = driven(Drive(Point(), 3, 2, DT), starts, goals, until=5.0)
    assert int(memory.report.contacts) == 1
    np.testing.assert_allclose(float(memory.report.smallest_distance), -0.05, atol=1e-12)
    assert float(jnp.linalg.norm(state.position - jnp.asarray(goals), axis=1).max()) < 0.1


def test_out_of_a_horseshoe_and_who_cannot_get_out_is_stuck() -> None:
    walls = [polygon(HORSESHOE), box([4, -0.3], [4.4, 0.3]), disc([-3, 0], 0.3)]
    drive = Drive(Point(), 3, 2, DT, walls)
    starts, goals = np.array([[0.5, 0.0], [0.5, 0.5], [-4.0, 0.0]]), np.array([[5.0, 0.0], [5.0, 1.0], [0.5, -0.4]])
    paths = jnp.asarray(Planner(drive.map, float(drive.size.max())).paths(starts, goals))
    state, memory = driven(drive, starts, goals, until=25.0, paths=paths)
    assert bool(jnp.all(drive.arrived(state, jnp.asarray(goals))))
    assert int(memory.report.contacts) == int(memory.report.collisions) == 0
    assert float(memory.report.clearance) >= 0.0
    straight, without = driven(drive, starts, goals, until=25.0, paths=jnp.repeat(jnp.asarray(goals)[:, None], paths.shape[1], axis=1))
    assert drive.stuck(straight, without, jnp.asarray(goals)) == [0, 1]
    assert int(without.report.collisions) == 0


def test_measured_positions_are_what_counts() -> None:
    noise, starts = 0.01, circle(6, 1.0)
    drive = Drive(Point(), 6, 2, DT, noise=noise)
    rng, state = np.random.default_rng(0), drive.model.start(jnp.asarray(starts))
    memory = drive.start(state)
    step = jax.jit(
        lambda state, memory, seen: drive.step(state, memory, jnp.asarray(-starts), measured=seen)[:2], compiler_options=quick_compilation()
    )
    for _ in range(200):
        angle = rng.uniform(0, 2 * np.pi, 6)
        error = noise * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        state, memory = step(state, memory, drive.model.place(state) + jnp.asarray(error))
    assert int(memory.report.contacts) == 0
    assert float(jnp.linalg.norm(state.position + jnp.asarray(starts), axis=1).max()) < 0.2


@pytest.mark.parametrize("count", [30, 120])
def test_neighbours_are_the_nearest_while_everybody_moves(count: int) -> None:
    rng = np.random.default_rng(1)
    place = rng.uniform(-3, 3, (count, 2))
    known = candidates(jnp.asarray(place))
    look = jax.jit(lambda known, place: near(known, place, 8, 1.5), compiler_options=quick_compilation())
    rebuilt = 0
    for _ in range(60):
        place = place + 0.05 * rng.normal(size=place.shape)
        before = known.found
        known, around = look(known, jnp.asarray(place))
        rebuilt += int(jnp.any(known.found != before))
        distance = np.linalg.norm(place[:, None] - place, axis=2) + np.diag(np.full(count, np.inf))
        for index in range(count):
            expected = [other for other in np.argsort(distance[index])[:8] if distance[index, other] <= 1.5]
            who = np.asarray(around.who[index])
            assert sorted(who[who < count].tolist()) == sorted(expected)
            rest = np.delete(distance[index], who[who < count])
            assert rest.min() >= float(around.beyond[index]) * (1 - 1e-6)
    assert rebuilt < 60
    assert (rebuilt > 0) == (count > 41)


def test_paths_are_clear_and_no_longer_than_need_be() -> None:
    obstacles = map_of([polygon(HORSESHOE), disc([2.5, 0], 0.4)], 2)
    solid = shapely.union_all([shapely.Polygon(HORSESHOE), shapely.Point(2.5, 0).buffer(0.4, quad_segs=64)])
    planner = Planner(obstacles, 0.1)
    start, goal = np.array([0.5, 0.0]), np.array([4.0, 0.0])
    path = planner.path(start, goal)
    line = shapely.LineString([start, *path])
    np.testing.assert_array_equal(path[-1], goal)
    assert shapely.distance(line, solid) >= 0.1 - 1e-9
    least = 1.5 + np.hypot(0.0, 0.3) + 2.2 + np.hypot(2.8, 1.0)  # out, round the corner, along, across: past corners without a size
    assert least - 0.2 < line.length < 1.15 * least
    np.testing.assert_array_equal(planner.path(goal, goal + 1.0), [goal + 1.0])
    walls = [box([-1, -1], [1, -0.9]), box([-1, 0.9], [1, 1]), box([-1, -1], [-0.9, 1]), box([0.9, -1], [1, 1])]
    walled = Planner(map_of(walls, 2), 0.1)
    np.testing.assert_array_equal(walled.path(np.zeros(2), goal), [goal])
    assert planner.stale(planner.paths(start[None], goal[None]), goal[None] + 0.2, 0.1)
    assert not planner.stale(planner.paths(start[None], goal[None]), goal[None] + 0.05, 0.1)


def test_paths_in_space_go_round_balls_and_boxes() -> None:
    obstacles = map_of([disc([0, 0, 0], 1), box([1.5, -1, -1], [2, 1, 1])], 3)
    start, goal = np.array([-2.0, 0.0, 0.0]), np.array([3.0, 0.0, 0.0])
    path = Planner(obstacles, 0.1).path(start, goal)
    corners = np.array([start, *path])
    points = np.concatenate([a + np.linspace(0, 1, 100)[:, None] * (b - a) for a, b in itertools.pairwise(corners)])
    assert float(jnp.min(obstacles.signed_distance(jnp.asarray(points)))) > 0.1
    length = np.linalg.norm(np.diff(corners, axis=0), axis=1).sum()
    assert 5.0 < length < 6.5


def test_settings_that_cannot_be_are_refused() -> None:
    with pytest.raises(consat.errors.InvalidInput, match="unicycle robots move in 2 dimensions, but the team has 3"):
        Drive(Unicycle(), 4, 3, DT)
    with pytest.raises(consat.errors.InvalidInput, match=re.escape("robots.share: must be above 0 and at most 1, but is 1.5")):
        Drive(Point(), 4, 2, DT, share=1.5)
    with pytest.raises(consat.errors.InvalidInput, match=re.escape("robots.dt: must be positive, but is 0")):
        Drive(Quadrotor(), 4, 2, 0.0)


def test_one_robot_alone_and_none_in_range_are_no_special_cases() -> None:
    drive = Drive(Point(), 1, 2, DT)
    state, memory = driven(drive, [[0.0, 0.0]], [[1.0, 0.0]], until=4.0)
    assert bool(drive.arrived(state, jnp.asarray([[1.0, 0.0]])).all())
    assert np.isinf(float(memory.report.smallest_distance))
    assert np.isinf(float(memory.report.clearance))


@pytest.mark.parametrize("model", [Point(), Double(), Unicycle(), Quadrotor()], ids=lambda model: type(model).__name__.lower())
def test_what_is_carried_has_the_same_types_before_and_after_a_step(model: Any) -> None:
    drive, place = Drive(model, 3, 2, DT, [disc([5, 5], 1)]), jnp.asarray(circle(3, 1.0))

    def begun(place: Any) -> Any:
        state = model.start(place)
        return state, drive.start(state)

    before = jax.eval_shape(begun, place)
    after = jax.eval_shape(lambda state, memory: drive.step(state, memory, -place)[:2], *before)
    for (path, one), other in zip(jax.tree_util.tree_leaves_with_path(before), jax.tree.leaves(after), strict=True):
        kinds = [(leaf.shape, leaf.dtype, leaf.weak_type) for leaf in (one, other)]
        assert kinds[0] == kinds[1], f"{jax.tree_util.keystr(path)}: the program of a run would be compiled twice"
