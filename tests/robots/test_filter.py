"""The filter's small problem against piqp, and the theorem: inside its conditions nothing touches, outside them that is said."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.oracle import problems, solved
from consat.numerics import quick_compilation
from consat.robots import Double, Drive, Fleet, Point, Quadrotor, Unicycle, box, conditions, disc, polygon
from consat.robots.filter import joined, margin, nearest, neighbour_planes, obstacle_planes, steered
from consat.robots.neighbours import Near, candidates, near
from consat.robots.obstacles import map_of

DT = 0.05
quickly = functools.partial(jax.jit, compiler_options=quick_compilation())


@pytest.mark.parametrize(("dimension", "rows"), [(1, 3), (2, 8), (3, 6)])
def test_small_problem_is_solved_as_piqp_does(dimension: int, rows: int) -> None:
    """`benchmarks/robots.py --part oracle` compares a million."""
    count = 400
    asked = problems(count, dimension, rows, seed=dimension)
    answers = solved(asked)
    found, there = map(np.asarray, quickly(nearest)(*asked, np.full(count, 1e3)))
    assert 0.2 < there.mean() < 0.99
    sure = answers.exact | ~answers.there  # it runs out of digits on one problem of some hundreds
    assert sure.mean() > 0.98
    np.testing.assert_array_equal(there[sure], answers.there[sure])
    assert np.all((np.einsum("nkd,nd->nk", asked.normals, found) >= asked.least - 1e-9)[there])
    compared = there & answers.exact
    np.testing.assert_allclose(found[compared], answers.point[compared], atol=1e-5)  # piqp stops at 1e-12 of the squared distance's gap


@pytest.mark.parametrize("dimension", [2, 3])
def test_small_problem_within_a_ball_is_a_projection(dimension: int) -> None:
    """u is the point of a convex set nearest to w if and only if (w − u)·(v − u) ≤ 0 for all v of the set."""
    count, radius = 400, 0.7
    wish, normals, least = problems(count, dimension, 6, seed=7)
    found, there = map(np.asarray, quickly(nearest)(wish, normals, least, np.full(count, radius)))
    rng = np.random.default_rng(8)
    directions = rng.normal(size=(4000, dimension))
    samples = radius * directions / np.linalg.norm(directions, axis=1)[:, None] * rng.random((4000, 1)) ** (1 / dimension)
    for index in range(count):
        inside = samples[np.all(samples @ normals[index].T >= least[index], axis=1)]
        assert there[index] or len(inside) == 0
        if there[index]:
            assert np.all(normals[index] @ found[index] >= least[index] - 1e-9)
            assert np.linalg.norm(found[index]) <= radius + 1e-9
            assert np.all((inside - found[index]) @ (wish[index] - found[index]) <= 1e-9)


def packed(rng: np.random.Generator, sizes: np.ndarray, dimension: int, side: float) -> np.ndarray:
    """Random places at which bodies of these sizes don't overlap."""
    places: list[np.ndarray] = []
    while len(places) < len(sizes):
        place = rng.uniform(-side, side, dimension)
        if all(np.linalg.norm(place - other) > sizes[index] + sizes[len(places)] for index, other in enumerate(places)):
            places.append(place)
    return np.array(places)


def filtered(model: Any, state: Any, wish: Any, planes: Any, dt: float) -> Any:
    command, moves, _ = steered(model, state, wish, wish, planes, dt)
    return command, moves


def hunted(model: Any, dimension: int, *, dt: float = DT, share: float = 1.0, seen: int = 8, seed: int = 0, steps: int = 150) -> float:
    """The smallest gap between what 24 robots keep, in steps and halfway through them, while each wishes at random or into the crowd."""
    count, rng = 24, np.random.default_rng(seed)
    size = model.size(count, dt) + margin(model, count, dt, 0.0, share)
    top = float(jnp.max(model.pace(count)))
    state = model.start(
        jnp.asarray(packed(rng, np.asarray(size), dimension, side=3.2 * float(jnp.max(size)) * count ** (1 / dimension) / 2))
    )
    known = candidates(model.place(state))

    @quickly
    def step(state: Any, known: Any, wish: Any) -> Any:
        place = model.place(state)
        known, around = near(known, place, seen, jnp.inf)
        planes = neighbour_planes(place, model.stop(state, dt) if model.inertial else None, size, around, share)
        command, _ = filtered(model, state, wish, planes, dt)
        places = jnp.stack([model.body(model.step(state, command, part * dt)) for part in (0.5, 1.0)])
        return model.step(state, command, dt), known, places

    radius = np.broadcast_to(np.asarray(model.radius), (count,))
    off, least = radius[:, None] + radius + np.diag(np.full(count, -np.inf)), np.inf
    for _ in range(steps):
        place = np.asarray(model.place(state))
        inwards = -place / (np.linalg.norm(place, axis=1)[:, None] + 1e-9)
        wish = np.where(rng.random((count, 1)) < 0.6, 2 * top * inwards, 2 * top * rng.normal(size=place.shape))
        state, known, places = step(state, known, jnp.asarray(wish))
        least = min(least, *((np.linalg.norm(each[:, None] - each, axis=2) - off).min() for each in np.asarray(places)))
    return least


@pytest.mark.parametrize(
    ("model", "dimension"),
    [
        (Point(radius=np.linspace(0.05, 0.2, 24)), 2),
        (Double(speed=1.0, acceleration=1.5), 2),
        (Quadrotor(), 3),
        (Fleet([Point(), Unicycle(speed=np.linspace(0.2, 0.8, 8)), Double()], np.arange(24) % 3), 2),
    ],
    ids=["points", "double", "quadrotors-3d", "fleet"],
)
def test_nobody_touches_whatever_is_wished(model: Any, dimension: int) -> None:
    assert hunted(model, dimension, steps=60 if dimension == 3 else 150) >= 0.0


@pytest.mark.parametrize(
    ("model", "dt", "share", "seen"),
    [(Double(speed=1.0), 0.4, 1.0, 8), (Point(speed=1.0), 0.05, 0.3, 8), (Point(speed=1.0), 0.05, 1.0, 1)],
    ids=["slow", "small-share", "one-plane"],
)
def test_nobody_touches_whatever_the_settings(model: Any, dt: float, share: float, seen: int) -> None:
    assert hunted(model, 2, dt=dt, share=share, seen=seen) >= 0.0


@pytest.mark.parametrize("model", [Double(), Unicycle()], ids=["double", "unicycle"])
def test_no_obstacle_is_touched_whatever_is_wished(model: Any) -> None:
    corner = polygon([[-2, -2], [2, -2], [2, 2], [1.5, 2], [1.5, -1.5], [-2, -1.5]])
    obstacles = map_of([corner, disc([0, 0], 0.3), box([-1, 1], [-0.5, 2])], 2)
    count, rng = 16, np.random.default_rng(2)
    size = model.size(count, DT) + margin(model, count, DT, 0.0)
    free: list[np.ndarray] = []
    while len(free) < count:
        place = rng.uniform(-2.5, 2.5, 2)
        if float(obstacles.signed_distance(jnp.asarray(place[None]))[0]) > float(size[0]):
            free.append(place)
    state = model.start(jnp.asarray(np.array(free)))

    @quickly
    def step(state: Any, wish: Any) -> Any:
        place, stop = model.place(state), model.stop(state, DT)
        planes = obstacle_planes(place, stop if model.inertial else None, size, obstacles, 3)
        command, _ = filtered(model, state, wish, planes, DT)
        after = model.step(state, command, DT)
        clear = [obstacles.signed_distance(model.body(each)) for each in (model.step(state, command, 0.5 * DT), after)]
        return after, jnp.min(jnp.stack(clear)) - model.radius

    least = np.inf
    for _ in range(200):
        toward = rng.uniform(-1, 1, 2) * 2.0
        wish = np.where(rng.random((count, 1)) < 0.7, toward - np.asarray(model.place(state)), rng.normal(size=(count, 2)))
        state, clearance = step(state, jnp.asarray(3 * wish))
        least = min(least, float(clearance))
    assert least >= 0.0


def measured_apart(model: Any, noise: float, allowed: float, steps: int = 300) -> float:
    """The smallest gap between twelve bodies that wish into the crowd, when each measures everybody, itself too, with errors of its own."""
    count, rng = 12, np.random.default_rng(3)
    size = model.size(count, DT) + margin(model, count, DT, allowed)
    state = model.start(jnp.asarray(packed(rng, np.asarray(size) * 1.1, 2, side=1.2)))

    def of_one(state: Any, seen: Any, index: Any) -> Any:
        _, around = near(candidates(seen), seen, 8, jnp.inf)
        planes = neighbour_planes(seen, None, size, around)
        shift = jnp.sum(planes.normals * (model.place(state) - seen)[:, None], axis=2)
        planes = planes._replace(least=planes.least + shift)
        return filtered(model, state, -3.0 * model.place(state), planes, DT)[0][index]

    @quickly
    def step(state: Any, errors: Any) -> Any:
        seen = model.place(state)[None] + errors
        commands = jax.vmap(of_one, in_axes=(None, 0, 0))(state, seen, jnp.arange(count))
        return model.step(state, commands, DT)

    least, own = np.inf, np.diag(np.full(count, np.inf))
    for _ in range(steps):
        angle = rng.uniform(0, 2 * np.pi, (count, count))
        errors = noise * np.stack([np.cos(angle), np.sin(angle)], axis=2)
        state = step(state, jnp.asarray(errors))
        body = np.asarray(model.body(state))
        least = min(least, (np.linalg.norm(body[:, None] - body, axis=2) + own).min() - 2 * model.radius)
    return least


@pytest.mark.parametrize("model", [Point(), Unicycle()], ids=["point", "unicycle"])
def test_nobody_touches_where_noise_is_allowed_for(model: Any) -> None:
    assert measured_apart(model, noise=0.01, allowed=0.01) >= 0.0


def test_noise_that_is_not_allowed_for_touches_and_is_said() -> None:
    assert measured_apart(Point(), noise=0.01, allowed=0.0) < 0.0
    drive = Drive(Point(), 2, 2, DT)
    state = drive.model.start(jnp.asarray([[0.0, 0.0], [1.0, 0.0]]))
    assert conditions(drive, state, noise=0.01) == ("noise: positions are measured to 0.01 m, but the filter allows for 0 m",)


def test_conditions_that_do_not_hold_are_named() -> None:
    near_by = jnp.asarray([[0.0, 0.0], [0.15, 0.0]])
    apart = jnp.asarray([[0.0, 0.0], [1.0, 0.0]])
    fine = Drive(Point(), 2, 2, DT)
    assert conditions(fine, fine.model.start(apart)) == ()

    def first(drive: Drive, place: Any, **given: Any) -> str:
        return " ".join(each.split(":")[0] for each in conditions(drive, drive.model.start(place), **given))

    assert first(fine, near_by) == "start"
    assert first(Drive(Point(), 2, 2, DT, [disc([0, 0.2], 0.15)]), apart) == "start"
    assert first(fine, apart, wind=1.0) == "wind"
    assert first(Drive(Unicycle(), 2, 2, DT), apart, wind=1.0) == ""
    assert first(fine, apart, paused=0.2) == "sampling"
    assert first(Drive(Point(), 2, 2, DT, sensing=0.2), apart) == "sensing"
    assert first(Drive(Double(), 2, 2, DT, noise=0.01), apart) == "noise"
    moving = fine.start(fine.model.start(apart)).report._replace(strayed=jnp.asarray(0.02))
    assert first(fine, apart, report=moving) == "tube"
    near_to_each_other = fine.start(fine.model.start(apart)).report._replace(overlap=jnp.asarray(0.02))
    assert conditions(fine, report=near_to_each_other)[0].startswith("distance: robots, or one and an obstacle, were 0.02 m nearer")
    double = Drive(Double(), 2, 2, DT)
    state = double.model.start(apart)._replace(velocity=jnp.ones((2, 2)))
    assert conditions(double, state) == ("start: robots must be at rest",)


def test_who_has_no_plane_limits_the_speed() -> None:
    """Four robots around one that has a plane for the nearest only: it may move as far as half the gap to the second nearest."""
    place = jnp.asarray([[0.0, 0.0], [0.3, 0.0], [-0.32, 0.0], [0.0, 0.5], [0.0, -0.6]])
    planes = quickly(lambda place: neighbour_planes(place, None, jnp.full(5, 0.1), near(candidates(place), place, 1, 10.0)[1]))(place)
    np.testing.assert_allclose(planes.slack[0], 0.5 * (0.32 - 0.2), atol=1e-6)
    model = Point(speed=10.0)
    command, moves = quickly(lambda wish: filtered(model, model.start(place), wish, planes, DT))(jnp.asarray([[-9.0, 0.0]] * 5))
    assert bool(moves[0])
    np.testing.assert_allclose(command[0], [-0.06 / DT, 0.0], atol=1e-4)


def test_planes_of_both_kinds_count() -> None:
    place = jnp.asarray([[0.0, 0.0], [0.4, 0.0]])
    around = Near(jnp.asarray([[1], [0]]), jnp.full(2, jnp.inf))
    size = jnp.full(2, 0.1)
    wall = map_of([box([-1, 0.15], [1, 1])], 2)
    wish = jnp.asarray([[5.0, 5.0], [0.0, 0.0]])

    @quickly
    def commands(wish: Any) -> Any:
        planes = joined(neighbour_planes(place, None, size, around), obstacle_planes(place, None, size, wall, 4))
        return filtered(Point(), Point().start(place), wish, planes, 1.0)

    command, _ = commands(wish)
    np.testing.assert_allclose(command[0], [0.1, 0.05], atol=1e-12)
