"""Distances against Shapely, and an error of its own for each way to get an obstacle or a start wrong."""

import re
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import shapely

import consat.errors
from consat.numerics import quick_compilation
from consat.robots import box, disc, polygon, start_faults
from consat.robots.obstacles import map_of

HORSESHOE = [[-1, -1], [1.2, -1], [1.2, 1], [-1, 1], [-1, 0.8], [1, 0.8], [1, -0.8], [-1, -0.8]]


@pytest.mark.parametrize("order", [1, -1], ids=["counter-clockwise", "clockwise"])
def test_distance_is_shapelys_with_a_sign_and_its_gradient_points_away(order: int) -> None:
    obstacles = map_of([polygon(HORSESHOE[::order]), disc([2.5, 0], 0.4), box([-0.2, 2], [0.2, 3])], 2)
    points = np.random.default_rng(0).uniform(-3, 4, (500, 2))
    whole = shapely.union_all([shapely.Polygon(HORSESHOE), shapely.Point(2.5, 0).buffer(0.4, quad_segs=256), shapely.box(-0.2, 2, 0.2, 3)])
    inside = shapely.contains_xy(whole, points)
    expected = shapely.distance(shapely.points(points), whole.boundary) * np.where(inside, -1, 1)
    assert 10 < inside.sum() < 250
    look = jax.jit(
        jax.vmap(jax.value_and_grad(lambda point: obstacles.signed_distance(point[None])[0])), compiler_options=quick_compilation()
    )
    distance, gradient = map(np.asarray, look(points))
    np.testing.assert_allclose(distance, expected, atol=1e-5)  # the circle has 1024 corners
    np.testing.assert_allclose(np.linalg.norm(gradient, axis=1), 1.0, atol=1e-9)
    beyond = np.asarray(look(points + 0.01 * gradient)[0])[~inside]
    assert np.mean(np.abs(beyond - expected[~inside] - 0.01) < 1e-4) > 0.95  # but where another part becomes the nearest


def test_balls_and_boxes_in_space() -> None:
    obstacles = map_of([disc([0, 0, 0], 1), box([2, -1, -1], [3, 1, 1])], 3)
    points = jnp.asarray([[0.0, 0.0, 2.0], [1.5, 0.0, 0.0], [2.5, 0.0, 0.9], [4.0, 2.0, 0.0]])
    np.testing.assert_allclose(obstacles.signed_distance(points), [1.0, 0.5, -0.1, np.sqrt(2)], atol=1e-12)
    assert np.isinf(map_of([], 3).signed_distance(points)).all()


def test_closest_points_of_a_segment_are_those_of_shapely() -> None:
    obstacles = map_of([polygon(HORSESHOE), disc([2.5, 0], 0.4), box([-0.2, 2], [0.2, 3])], 2)
    parts = [shapely.Point(2.5, 0).buffer(0.4, quad_segs=512), shapely.box(-0.2, 2, 0.2, 3)]
    parts += [shapely.LineString([a, b]) for a, b in zip(HORSESHOE, HORSESHOE[1:] + HORSESHOE[:1], strict=True)]
    rng = np.random.default_rng(1)
    start = rng.uniform(-3, 4, (60, 2))
    stop = start + rng.normal(size=(60, 2))
    index = jnp.broadcast_to(jnp.arange(10)[None], (60, 10))
    own, other = jax.jit(obstacles.closest, compiler_options=quick_compilation())(start, stop, index)
    for row in range(60):
        line = shapely.LineString([start[row], stop[row]])
        np.testing.assert_allclose(
            np.linalg.norm(own[row] - other[row], axis=1), [shapely.distance(line, part) for part in parts], atol=1e-5
        )


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda: disc([0], 1), "obstacle 'disc', center: must be 2 or 3 finite numbers, but is [0]"),
        (lambda: disc([0, 0], -1), "obstacle 'disc', radius: must be a positive finite number, but is -1"),
        (lambda: box([0, 0], [1, 0]), "obstacle 'box', high: must be above low, [0.0, 0.0], on every axis, but is [1.0, 0.0]"),
        (lambda: box([0, 0], [1, 1, 1]), "obstacle 'box', high: must have as many numbers as low, 2, but has 3"),
        (lambda: polygon([[0, 0], [1, 1]]), "obstacle 'polygon', vertices: must be at least 3, but are 2"),
        (lambda: polygon([[0, 0], [1, 1, 1], [2, 0]]), "must be points of 2 finite numbers each"),
        (lambda: polygon([[0, 0], [1, 0], [1, 1], [0, 0]]), "vertex 3 repeats vertex 0, [0.0, 0.0]; give each once"),
        (lambda: polygon([[0, 0], [1, 1], [1, 0], [0, 1]]), "does not cross itself, but edges 0 and 2 meet"),
        (lambda: polygon([[0, 0], [1, 1], [2, 2]]), "lie on one line"),
        (lambda: map_of([disc([0, 0, 0], 1)], 2), "obstacle 0 (disc): lies in 3 dimensions, but the team in 2"),
        (lambda: map_of([polygon([[0, 0], [1, 0], [0, 1]])], 3), "in space there are discs (balls) and boxes"),
        (lambda: map_of([7], 2), "obstacle 0: must be made by disc, box or polygon, but is 7"),
    ],
)
def test_what_is_wrong_is_said(make: Any, text: str) -> None:
    with pytest.raises(consat.errors.InvalidInput, match=re.escape(text)):
        make()


def test_starts_in_obstacles_or_on_top_of_each_other_are_faults() -> None:
    starts = np.array([[0.0, 0.0], [3.0, 0.0], [3.1, 0.0], [1.05, 0.0]])
    faults = start_faults(["a", "b", "c", "d"], starts, np.full(4, 0.1), map_of([disc([0, 0], 1)], 2))
    assert [str(fault) for fault in faults] == [
        "agent 'a': start [0.0, 0.0] must be 0.1 m or more from every obstacle, but is inside one",
        "agent 'd': start [1.05, 0.0] must be 0.1 m or more from every obstacle, but is 0.05 m",
        "agent 'c': start must be 0.2 m or more from that of agent 'b', but is 0.1 m: their bodies overlap",
    ]
    assert faults[0].path == ("agents", 0, "start")
