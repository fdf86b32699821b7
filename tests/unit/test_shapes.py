"""The geometry that is read off constraints; and the unit of lengths, which figures and exports name."""

from __future__ import annotations

import numpy as np
import pytest

import consat as cs
from consat.numerics import float64
from consat.problem.objective import margins
from consat.views import space
from consat.views.shapes import alike, boxes, shapes


def several() -> cs.Team:
    return cs.Team(
        [
            cs.Agent("a", [cs.within([1, 2], 3), cs.outside([0, 0], 1), cs.halfspace([3, 4], 10)]),
            cs.Agent("b", [cs.outside([0, 0], 1), cs.near("a", 2), cs.expr("1 - norm2(b)")]),
            cs.Agent("c", [cs.near("a", 2), cs.displacement("b", [1, 0], 0.5), cs.apart("a", 0.25), *cs.box([-1, -2], [3, 4])]),
        ],
        links="line",
    )


def test_balls_are_told_once_with_their_owners() -> None:
    balls = shapes(several()).balls
    told = {
        (tuple(balls.center[k]), int(balls.around[k]), float(balls.radius[k]), bool(balls.keeps_out[k])): balls.owners[k]
        for k in range(len(balls.radius))
    }
    assert told == {
        ((1, 2), -1, 3, False): (0,),
        ((0, 0), -1, 1, True): (0, 1),
        ((0, 0), 0, 2, False): (1, 2),
        ((1, 0), 1, 0.5, False): (2,),
        ((0, 0), 0, 0.25, True): (2,),
    }
    x = np.array([[5.0, 6.0], [7.0, 8.0], [0.0, 0.0]])
    moved = {tuple(center) for center, around in zip(balls.at(x), balls.around, strict=True) if around >= 0}
    assert moved == {(5, 6), (8, 8)}


@float64
def test_points_of_balls_and_walls_are_where_the_constraint_begins_to_hold() -> None:
    team, random = several(), np.random.default_rng(1)
    x = random.uniform(-1, 1, (3, 2))
    found = shapes(team)
    walled = [cs.Agent("a", [cs.halfspace([3, 4], 10)]), cs.Agent("b"), cs.Agent("c", [*cs.box([-1, -2], [3, 4])])]
    alone = cs.Team(walled, links="line")
    for k in range(len(found.walls.offset)):
        foot = found.walls.offset[k] * found.walls.normal[k]
        [owner] = found.walls.owners[k]
        alone = cs.Team(
            [cs.Agent("a", [cs.halfspace([3, 4], 10)]), cs.Agent("b"), cs.Agent("c", [*cs.box([-1, -2], [3, 4])])], links="line"
        )
        for step, sign in ((-1e-6, 1), (1e-6, -1)):
            moved = x.copy()
            moved[owner] = foot + step * found.walls.normal[k]
            assert np.sign(margins(alone, moved)[owner]) == sign
    assert np.linalg.norm(found.walls.normal, axis=1) == pytest.approx(1.0)
    assert found.others.tolist() == [5]


def test_alike_are_constraints_with_the_same_region() -> None:
    assert alike(several()).tolist() == [0, 1, 2, 1, 4, 5, 4, 7, 8, 9, 10, 11, 12]


def test_boxes_and_their_faces() -> None:
    assert boxes(several()).tolist() == [[[-1, -2], [3, 4]]]
    team = cs.Team([cs.Agent("a", [*cs.box([-1, -2], [3, 4])])])
    faces = [
        sorted(map(tuple, np.round(corners, 9) + 0.0)) for _, corners in space.faces(shapes(team).walls, np.full(2, -9.0), np.full(2, 9.0))
    ]
    sides = [[(-1, -2), (-1, 4)], [(-1, -2), (3, -2)], [(3, -2), (3, 4)], [(-1, 4), (3, 4)]]
    assert sorted(faces) == sorted(sides)


# ---- the unit


def test_unit_is_kept_by_files_and_by_parts() -> None:
    text = "consat: 1\nname: yard\nunit: m\nagents: [{id: a, constraints: [{kind: within, center: [0, 0], radius: 1}]}]\n"
    scenario = cs.loads(text)
    assert scenario.team.unit == "m"
    assert cs.loads(cs.dump(scenario.team)).team.unit == "m"
    assert cs.loads(text, overrides=["unit=km"]).team.unit == "km"
    assert scenario.team.part(np.array([0]))[0].unit == "m"
    assert cs.loads(text.replace("unit: m\n", "")).team.unit is None
    assert "unit" not in cs.dump(cs.Team([cs.Agent("a")]))


@pytest.mark.parametrize("unit", ["5", "[m]", "''", "a-unit-that-is-far-too-long"])
def test_a_unit_that_is_none_is_a_fault_in_its_place(unit: str) -> None:
    with pytest.raises(cs.InvalidScenario) as caught:
        cs.loads(f"consat: 1\nunit: {unit}\nagents: [{{id: a}}]\n", "yard")
    assert str(caught.value).startswith("yard:2:7: unit: unit is ")
    assert "printable text of at most 16 letters, such as m" in str(caught.value)


def test_a_folder_does_not_hide_the_packaged_scenario_of_its_name(tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "case-b").mkdir()  # as `consat run case-b --out case-b` makes it
    assert cs.load("case-b").name == "case-b"
    (tmp_path / "case-c").write_text("consat: 1\nname: mine\nagents: [{id: a}]\n")
    assert cs.load("case-c").name == "mine"
