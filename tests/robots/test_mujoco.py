"""Bodies in MuJoCo: they follow their references, contacts are counted where there are some, and the filter leaves none."""

import sys
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import consat as cs
from consat.engine.carry import robot_placed
from consat.errors import InvalidSettings
from consat.numerics import float64, on_host, quick_compilation
from consat.robots import Double, Drive, Fleet, Quadrotor, Simulated, Unicycle, box, disc, polygon, simulated

pytest.importorskip("mujoco")
DT = 0.05


def resting(model: Simulated, place: Any) -> Any:
    return jax.tree.map(np.asarray, model.reference.start(jnp.asarray(place, dtype=float)))


def followed(model: Simulated, place: Any, steps: int, wind: Any = (0.0, 0.0, 0.0)) -> Any:
    """Bodies whose references rest at their places, (N, d), after so many steps."""
    place = np.array(place, dtype=float)
    bodies, rest = model.simulator.start(place), resting(model, place)
    for _ in range(steps):
        bodies = model.simulator.step(bodies, rest, rest, np.broadcast_to(np.array(wind)[: place.shape[1]], place.shape), dt=DT)
    return bodies


def swap(count: int = 8) -> np.ndarray:
    angle = 2.0 * np.pi * np.arange(count) / count
    return 1.05 * np.stack([np.cos(angle), np.sin(angle)], axis=1)


@float64
def swapped(model: Any, seconds: float) -> tuple[int, float]:
    """How many pairs touched when everybody drove straight to the opposite side without the filter, and who was farthest from it."""
    place = swap()
    drive = Drive(simulated("mujoco", model, 8, 2, []), 8, 2, DT)
    fleet, goals = drive.model, jnp.asarray(-place)

    @jax.jit(compiler_options=quick_compilation())
    def onward(state: Any, memory: Any) -> Any:
        way = goals - fleet.place(state)
        length = jnp.linalg.norm(way, axis=1)
        wish = way * (fleet.approach(length, DT) / jnp.maximum(length, 1e-9))[:, None]
        return drive.observed(after := fleet.step(state, fleet.command(state, wish, DT), DT), memory), after

    state = fleet.start(jnp.asarray(place))
    memory = drive.start(state)
    for _ in range(round(seconds / DT)):
        memory, state = onward(state, memory)
    left = jnp.max(jnp.linalg.norm(goals - drive.position(state), axis=1))
    return int(memory.report.contacts), float(left)


def test_a_swap_without_the_filter_has_contacts() -> None:
    contacts, left = swapped(Unicycle(), 5.0)
    assert contacts >= 4
    assert left > 0.3, "they hold each other up"


def test_a_swap_with_the_filter_has_none() -> None:
    result = cs.run("swap", simulator="mujoco", until=8)
    motion = result.summary["motion"]
    assert motion is not None
    assert motion["simulator"] == "mujoco"
    assert result.summary["status"] == "satisfied"
    assert motion["contacts"] == 0
    assert motion["smallest_distance"] > 0.0
    assert motion["unproven"] == [], "bodies stayed within their tubes"
    position, heading = result.data["position"].values, result.data["heading"].values
    assert np.abs(np.diff(np.unwrap(heading, axis=0), axis=0)).max() > 0.0
    axle = position - Unicycle().offset * np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    step = np.linalg.norm(np.diff(axle, axis=0), axis=2) * 30
    assert np.abs(step - 0.5).min() > 0.0, "what is recorded are bodies, which are never as exact as their references"


@pytest.mark.parametrize("model", [Quadrotor(), Unicycle(radius=0.15)], ids=["quadrotors", "drives"])
def test_who_overlaps_touches_and_who_does_not_overlap_does_not(model: Any) -> None:
    place = [[0.0, 0.0], [0.0, 0.29], [0.0, 0.6], [0.0, 0.91]]
    touching = followed(simulated("mujoco", model, 4, 2, []), place, 1).touching
    assert np.argwhere(touching).tolist() == [[0, 1]]


@pytest.mark.parametrize("model", [Quadrotor(radius=0.1), Unicycle(radius=0.1, offset=1e-6)], ids=["quadrotors", "drives"])
def test_obstacles_are_struck_where_they_are(model: Any) -> None:
    """By robots at a distance of 0.09 and 0.11 from a disc, a box, and the notch of a polygon that is not convex."""
    notched = polygon([[4, -1], [6, -1], [6, 1], [5.5, 1], [5.5, 0], [4.5, 0], [4.5, 1], [4, 1]])
    obstacles = [disc([0, 0], 0.5), box([2, -1], [3, 1]), notched]
    place = [[0.0, 0.59], [0.0, -0.61], [2.5, 1.09], [2.5, -1.11], [5.0, 0.09], [5.0, 0.31]]
    bodies = followed(simulated("mujoco", model, 6, 2, obstacles), place, 1)
    assert bodies.struck.tolist() == [True, False] * 3
    assert not bodies.touching.any()


def test_obstacles_in_space() -> None:
    model = simulated("mujoco", Quadrotor(radius=0.1), 3, 3, [disc([0, 0, 0], 0.5), box([2, 2, 2], [3, 3, 3])])
    assert followed(model, [[0, 0, 0.59], [0, 0.61, 0], [2.5, 1.91, 2.5]], 1).struck.tolist() == [True, False, True]


def test_a_quadrotor_holds_its_place_in_the_wind_and_a_drive_stands() -> None:
    flying = followed(simulated("mujoco", Quadrotor(), 2, 3, []), [[0, 0, 1], [3, 0, -1]], 120, wind=(1.5, -1.0, 0.5))
    np.testing.assert_allclose(flying.position, [[0, 0, 1], [3, 0, -1]], atol=2e-3)
    assert np.all(flying.inner[:, 25:28] @ np.array([1.5, -1.0, 0.5]) < -0.3), "it leans against it"
    standing = followed(simulated("mujoco", Unicycle(), 1, 2, []), [[0.05, 0.0]], 60, wind=(1.5, -1.0))
    np.testing.assert_allclose(standing.position[0, :2], 0.0, atol=2e-3)


def test_wind_that_is_too_strong_carries_a_quadrotor_away() -> None:
    away = followed(simulated("mujoco", Quadrotor(), 1, 3, []), [[0, 0, 0]], 60, wind=(60.0, 0.0, 0.0))
    assert away.position[0, 0] > 0.5


@float64
def test_a_reference_waits_for_its_body() -> None:
    """A wall that is not on the filter's map holds the body up."""
    for model, sideways in ((Quadrotor(), 0.15), (Unicycle(), 0.1)):
        robots = simulated("mujoco", model, 1, 2, [box([0.5, -1.0], [1.0, 1.0])])
        step = jax.jit(lambda state, robots=robots: robots.step(state, robots.command(state, jnp.array([[0.5, 0.0]]), DT), DT))
        state = robots.start(jnp.zeros((1, 2)))
        for _ in range(80):
            state = step(state)
        assert float(robots.body(state)[0, 0]) < 0.5 - sideways + 0.02
        assert float(robots.place(state)[0, 0]) < 0.65
        assert bool(state.bodies.struck[0])


def test_a_step_depends_on_the_state_alone() -> None:
    """Another simulator goes on bit for bit: that is what checkpoints need, contacts included."""
    model = Fleet([Unicycle(), Quadrotor(radius=0.1)], np.array([0, 1, 0]))
    place = np.array([[0.0, 0.0], [0.13, 0.0], [1.0, 0.0]])
    one, other = (simulated("mujoco", model, 3, 2, []) for _ in range(2))
    begun = followed(one, place, 1, wind=(1.0, 0.5))
    assert begun.touching.any()
    rest = resting(one, place)
    followed(other, place + 1.0, 2)
    ends = [each.simulator.step(begun, rest, rest, np.ones((3, 2)), dt=DT) for each in (one, other)]
    for first, second in zip(*ends, strict=True):
        np.testing.assert_array_equal(first, second)


def test_what_commands_move_is_the_reference_and_the_tube_is_added_to_what_is_kept() -> None:
    model = simulated("mujoco", Fleet([Unicycle(), Quadrotor(tube=0.08)], np.array([1, 0])), 2, 2, [])
    assert isinstance(model.reference, Fleet)
    assert [type(kind) for kind in model.reference.models] == [Unicycle, Double]
    assert float(model.size(2, DT)[0]) == pytest.approx(0.15 + 0.08)
    assert float(model.size(2, DT)[1]) > 0.1 + 0.05 + 0.01 + 0.5 * 0.025


@float64
def test_a_drive_that_is_told_to_go_to_and_fro_stays_near_its_reference() -> None:
    count, rng, angle = 10, np.random.default_rng(0), np.zeros(10)
    place = np.stack([3.0 * np.arange(count), np.zeros(count)], axis=1)
    model = simulated("mujoco", Unicycle(), count, 2, [])
    step = jax.jit(lambda state, wish: model.step(state, model.command(state, wish, DT), DT), compiler_options=quick_compilation())
    state, strayed = model.start(jnp.asarray(place)), []
    for index in range(160):
        if index % 8 == 0:
            angle = rng.uniform(0.0, 2.0 * np.pi, count) if index % 16 == 0 else angle + np.pi
        state = step(state, jnp.asarray(0.5 * np.stack([np.cos(angle), np.sin(angle)], axis=1)))
        strayed.append(np.asarray(model.strayed(state)))
    assert np.quantile(strayed, 0.98) < model.simulator.tube[0]
    assert np.max(strayed) < model.simulator.tube[0] + 0.03


@float64
def test_a_session_puts_one_body_down_and_leaves_the_others_moving() -> None:
    model = simulated("mujoco", Fleet([Unicycle(), Quadrotor()], np.array([0, 1, 1])), 3, 2, [])
    place = np.array([[0.0, 0.0], [1.0, 0.0], [2.0, 0.0]])
    state = model.start(jnp.asarray(place))
    onward = jax.jit(lambda state: model.step(state, model.command(state, jnp.ones((3, 2)), DT), DT), compiler_options=quick_compilation())
    for _ in range(10):
        state = onward(state)
    placed = robot_placed(model, state, 1, np.array([[9.0, 9.0], [5.0, 4.0], [9.0, 9.0]]))
    np.testing.assert_array_equal(model.position(placed)[1], [5.0, 4.0])
    np.testing.assert_array_equal(placed.bodies.velocity[1], 0.0)
    for part in (model.position, model.place, lambda state: state.bodies.inner):
        np.testing.assert_array_equal(part(placed)[jnp.array([0, 2])], part(state)[jnp.array([0, 2])])
    assert np.linalg.norm(placed.bodies.velocity[2]) > 0.1


@float64
def test_numbers_reach_the_host_and_come_back_exactly() -> None:
    values = jnp.asarray([1.0 / 3.0, 1e-300, -0.0, np.inf])
    shape = jax.ShapeDtypeStruct((4,), jnp.float64)
    seen = jax.jit(lambda x: on_host(lambda y, flag: np.where(flag, y, 0.0), shape, x, x > -1.0))(values)
    np.testing.assert_array_equal(np.asarray(seen).view(np.uint64), np.asarray(values).view(np.uint64))


@pytest.mark.parametrize(
    ("robots", "simulator", "text"),
    [
        ("unicycle", "mujocco", "there is no simulator 'mujocco'"),
        ("point", "mujoco", "no body for point robots; use unicycle or quadrotor"),
        (None, "mujoco", "simulator mean something to robots only; give robots, too"),
    ],
)
def test_what_cannot_be_simulated_is_said(robots: str | None, simulator: str, text: str) -> None:
    with pytest.raises(InvalidSettings, match=text):
        cs.run("case-b", robots=robots, simulator=simulator)


def test_without_mujoco_it_is_said_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(InvalidSettings, match=r"install it with: pip install 'consat\[mujoco\]'"):
        cs.run("swap", simulator="mujoco")
