"""Robot models against integrators, their own limits, and each other."""

import functools
import math
import re
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import consat.errors
from consat.numerics import quick_compilation
from consat.robots import Double, Fleet, Point, Quadrotor, Unicycle

DT = 0.05
MODELS = [Point(), Double(), Unicycle(), Quadrotor()]
NAMES = ["point", "double", "unicycle", "quadrotor"]
quickly = functools.partial(jax.jit, compiler_options=quick_compilation())
every_model = pytest.mark.parametrize("model", MODELS, ids=NAMES)


@functools.cache
def compiled(model: Any) -> tuple[Callable[..., Any], Callable[..., Any], Callable[..., Any]]:
    """Step under a command, command for a velocity, and step of a halt."""
    return (
        quickly(lambda state, command: model.step(state, command, DT)),
        quickly(lambda state, velocity: model.command(state, velocity, DT)),
        quickly(lambda state: model.step(state, model.halt(state, DT), DT)),
    )


def under_way(model: Any, count: int, rng: np.random.Generator, steps: int = 10) -> Any:
    """A state after some steps towards random velocities."""
    state = model.start(jnp.asarray(rng.uniform(-3, 3, (count, 2))))
    step, command, _ = compiled(model)
    for _ in range(steps):
        state = step(state, command(state, jnp.asarray(rng.normal(size=(count, 2)))))
    return state


@every_model
def test_starts_at_rest_where_it_should(model: Any) -> None:
    position = jnp.asarray([[1.0, 2.0], [-0.5, 0.0]])
    state = model.start(position)
    np.testing.assert_allclose(model.place(state), position, atol=1e-15)
    np.testing.assert_allclose(model.stop(state, DT), position, atol=1e-15)
    after = model.step(state, model.halt(state, DT), DT)
    np.testing.assert_allclose(model.place(after), position, atol=1e-12)


@every_model
def test_comes_to_the_velocity_that_is_asked_for(model: Any) -> None:
    velocity = jnp.asarray([[0.2, 0.1], [-0.3, 0.1], [0.0, 0.0]])
    state = model.start(jnp.zeros((3, 2)))
    step, command, _ = compiled(model)
    for _ in range(60):
        before, state = state, step(state, command(state, velocity))
    # What a unicycle turns by in a step shortens the chord: it is the arc that has the speed.
    np.testing.assert_allclose((model.place(state) - model.place(before)) / DT, velocity, atol=1e-6)


@every_model
def test_limits_hold_whatever_is_asked_for(model: Any) -> None:
    rng = np.random.default_rng(1)
    state = under_way(model, 50, rng)
    step, command, _ = compiled(model)
    for _ in range(20):
        after = step(state, 3.0 * command(state, jnp.asarray(5 * rng.normal(size=(50, 2)))))
        at = model.body if isinstance(model, Unicycle) else model.place
        moved = jnp.linalg.norm(at(after) - at(state), axis=1)
        assert float(jnp.max(moved)) <= float(model.speed) * DT * (1 + 1e-9)
        state = after


@every_model
def test_one_robot_moves_as_it_does_among_many(model: Any) -> None:
    rng = np.random.default_rng(2)
    state = under_way(model, 5, rng)
    wish = jnp.asarray(rng.normal(size=(5, 2)))
    onward = quickly(lambda state, wish: model.place(model.step(state, model.command(state, wish, DT), DT)))
    whole = onward(state, wish)
    alone = jax.tree.map(lambda leaf: leaf[2:3], state)
    part = onward(alone, wish[2:3])
    np.testing.assert_allclose(part[0], whole[2], atol=1e-14)


@every_model
def test_lowest_bounds_the_whole_step_and_the_halt_after_it(model: Any) -> None:
    rng = np.random.default_rng(3)
    state = under_way(model, 40, rng)
    angle = rng.uniform(0, 2 * np.pi, (40, 6))
    normals = jnp.asarray(np.stack([np.cos(angle), np.sin(angle)], axis=2))
    command = compiled(model)[1](state, jnp.asarray(rng.normal(size=(40, 2))))
    lowest = np.asarray(model.lowest(state, command, normals, DT))
    reach = np.asarray(model.farthest(state, command, DT))
    start, seen, far = np.asarray(model.place(state)), np.full((40, 6), np.inf), np.zeros(40)

    def look(place: Any) -> None:
        nonlocal seen, far
        seen = np.minimum(seen, np.einsum("nkd,nd->nk", normals, place))
        far = np.maximum(far, np.linalg.norm(np.asarray(place) - start, axis=1))

    allowed = np.asarray(model.size(40, DT) - model.radius)[:, None]  # a unicycle's arc over its chord is in its size
    inside = compiled(model)[0](state, command)
    for part in (0.25, 0.5, 0.75, 1.0):
        look(model.place(model.step(state, command, DT * part)))
    for _ in range(40):
        look(model.place(inside))
        inside = compiled(model)[2](inside)
    start_level = np.einsum("nkd,nd->nk", normals, start)
    arc = allowed if isinstance(model, Unicycle) else 0.0
    assert np.all(seen >= np.minimum(lowest, start_level) - arc - 1e-9)
    assert np.all(far <= reach + np.max(arc) + 1e-9)


@every_model
def test_a_halt_stays_between_place_and_stop(model: Any) -> None:
    state = under_way(model, 40, np.random.default_rng(4))
    place, stop = np.asarray(model.place(state)), np.asarray(model.stop(state, DT))
    for _ in range(60):
        state = compiled(model)[2](state)
        now = np.asarray(model.place(state))
        detour = np.linalg.norm(now - place, axis=1) + np.linalg.norm(stop - now, axis=1) - np.linalg.norm(stop - place, axis=1)
        assert detour.max() < 1e-12


def test_a_unicycle_is_integrated_exactly_and_its_chord_points_where_asked() -> None:
    model = Unicycle()
    rng = np.random.default_rng(5)
    state = under_way(model, 30, rng)
    wish = rng.normal(size=(30, 2))
    command = model.command(state, jnp.asarray(wish), DT)
    after = model.step(state, command, DT)
    for index in range(30):
        v, omega = np.asarray(command[index])
        assert abs(v) <= 0.5 + 1e-12
        assert abs(omega) <= 3.6 + 1e-12
        whole = solve_ivp(
            lambda t, s, v=v, omega=omega: [v * math.cos(s[2]), v * math.sin(s[2]), omega],
            (0, DT),
            [*np.asarray(state.axle[index]), float(state.angle[index])],
            rtol=1e-11,
            atol=1e-12,
        )
        np.testing.assert_allclose([*after.axle[index], after.angle[index]], whole.y[:, -1], atol=1e-9)
    chord = np.asarray(model.place(after) - model.place(state))
    across = chord[:, 0] * wish[:, 1] - chord[:, 1] * wish[:, 0]
    assert np.abs(across).max() < 1e-9
    assert np.all(np.sum(chord * wish, axis=1) > 0)


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_quadrotor_stays_within_its_tube_and_its_tilt(dimension: int) -> None:
    model = Quadrotor()
    rng = np.random.default_rng(6)
    state = model.start(jnp.zeros((30, dimension)))
    step = quickly(lambda state, velocity: model.step(state, model.command(state, velocity, DT), DT))
    off, tilt = [], []
    for index in range(120):
        if index % 8 == 0:  # to and fro at full speed: the worst that a filter can ask for
            velocity = jnp.asarray(3.0 * rng.normal(size=(30, dimension)))
        state = step(state, velocity)
        off.append(float(jnp.max(jnp.linalg.norm(model.body(state) - model.place(state), axis=1))))
        tilt.append(float(jnp.max(jnp.arccos(jnp.clip(state.attitude[:, 2, 2], -1.0, 1.0)))))
    assert max(off) < model.tube
    assert max(tilt) < float(model.tilt) * 1.05  # the attitude loop overshoots its limit by less
    identity = jnp.swapaxes(state.attitude, 1, 2) @ state.attitude
    np.testing.assert_allclose(identity, np.broadcast_to(np.eye(3), identity.shape), atol=1e-9)


def test_wind_moves_what_flies_and_not_what_stands_on_wheels() -> None:
    wind = jnp.asarray([[1.0, 0.0]])
    for model, drifts in ((Point(), True), (Double(), True), (Unicycle(), False), (Quadrotor(), True)):
        state = model.start(jnp.zeros((1, 2)))
        step = quickly(lambda state, model=model: model.step(state, model.halt(state, DT), DT, wind))
        for _ in range(20):
            state = step(state)
        assert (abs(float(model.body(state)[0, 0])) > 1e-3 + abs(float(model.offset) if model.__class__ is Unicycle else 0.0)) == drifts


def test_a_fleet_is_its_kinds_in_the_order_of_the_robots() -> None:
    fleet = Fleet([Unicycle(offset=0.08), Quadrotor(speed=[0.7, 0.9])], np.array([1, 0, 1, 0]))
    position = jnp.asarray([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0], [3.0, 0.0]])
    state = fleet.start(position)
    wish = jnp.asarray([[1.0, 0.2], [0.3, 0.1], [0.5, 0.5], [-0.2, 0.3]])
    onward = quickly(lambda state: fleet.step(state, fleet.command(state, wish, DT), DT))
    for _ in range(5):
        state = onward(state)
    alone = Unicycle(offset=0.08)
    other = alone.start(position[jnp.array([1, 3])])
    for _ in range(5):
        other = alone.step(other, alone.command(other, wish[jnp.array([1, 3])], DT), DT)
    np.testing.assert_allclose(fleet.place(state)[jnp.array([1, 3])], alone.place(other), atol=1e-14)
    np.testing.assert_allclose(fleet.pace(4), [0.7, 0.5, 0.9, 0.5])
    assert fleet.dimensions == (2,)
    assert fleet.inertial


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda: Point(radius=0), "robot 'point', radius: must be positive, but is 0"),
        (lambda: Point(speed="fast"), "robot 'point', speed: must be a number or one number for each robot, but is 'fast'"),
        (lambda: Double(acceleration=math.nan), "robot 'double', acceleration: must be finite and at most 1e+06, but is nan"),
        (lambda: Unicycle(radius=[0.1, -0.1]), "robot 'unicycle', radius: must be positive, but is [0.1, -0.1]"),
        (lambda: Unicycle(radius=[0.1], speed=[1, 1]), "must have one length, but have radius 1, speed 2"),
        (lambda: Quadrotor(tilt=2.0), "robot 'quadrotor', tilt: must be below 1.571, but is 2.0"),
        (lambda: Quadrotor(acceleration=9.0), "robot 'quadrotor', tilt: must be at least 0.854 rad for an acceleration of 9 m/s²"),
        (lambda: Fleet([Point(), Point()], np.array([0, 0])), "must name each of 2 models by its index at least once, but has [0]"),
    ],
)
def test_parameters_that_cannot_be_are_refused(make: Any, text: str) -> None:
    with pytest.raises(consat.errors.InvalidInput, match=re.escape(text)):
        make()
