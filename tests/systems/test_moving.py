"""Constraints that move with time: schedules and expressions of t, followed by a run, and verdicts over its time."""

import itertools
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

import consat as cs
from consat.certify.optimum import max_min
from consat.certify.quadratics import shape_of

TORN = """
consat: 1
name: torn
agents:
  - {id: a, constraints: [{kind: within, center: [0, 0], radius: 1}]}
  - {id: b, constraints: [{kind: near, agent: a, radius: 1.5}]}
  - id: c
    constraints:
      - {kind: near, agent: b, radius: 1.5}
      - {kind: within, center: {times: [1, 5, 9], values: [[1, 0], [7, 0], [1, 0]]}, radius: 1, name: goal}
"""


@pytest.fixture(scope="module")
def torn() -> cs.Result:
    return cs.run(cs.loads(TORN, "torn"), rate=20, until=10)


def test_a_goal_that_moves_is_followed_and_margins_are_those_of_the_moment(torn: cs.Result) -> None:
    team = cs.loads(TORN).team
    for k in (0, 40, 100, 200):
        x, told = torn.data["position"].values[k], torn.data["agent_margin"].values[k]
        np.testing.assert_allclose(told, cs.margins(team.at(k / 20), x), atol=1e-9)
    assert torn.summary["status"] == "satisfied"
    motion = torn.summary["motion"]
    margin = torn.data["margin"].values
    assert motion is not None
    assert motion["duration"] == 10.0
    assert motion["satisfied_share"] == pytest.approx(np.mean(margin > 0))
    first = int(np.argmax(margin > 0))
    assert motion["satisfied_share_after"] == pytest.approx(np.mean(margin[first:] > 0))
    assert motion["worst_margin_after"] == pytest.approx(margin[first:].min())


def test_verdicts_cover_the_run_and_are_never_false(torn: cs.Result) -> None:
    team, told = cs.loads(TORN).team, torn.summary["verdicts"]
    assert told is not None
    assert [each["verdict"] for each in told] == ["feasible", "undecided", "infeasible", "undecided", "feasible"]
    assert told[0]["from"] == 0.0
    assert told[-1]["to"] == 10.0
    assert all(a["to"] == b["from"] for a, b in itertools.pairwise(told))
    assert sum(each["to"] - each["from"] for each in told if each["verdict"] == "undecided") < 0.1
    for time in np.linspace(0, 10, 41).tolist():
        margin = max_min(team.at(time)).margin
        for each in told:
            if each["from"] <= time <= each["to"] and abs(margin) > 1e-6:
                assert each["verdict"] in ("undecided", "feasible" if margin > 0 else "infeasible")
                upper = each["bounds"][1]
                assert upper is None or each["verdict"] == "undecided" or margin <= upper + 1e-6


def test_the_team_proves_nothing_while_constraints_move(torn: cs.Result) -> None:
    assert np.isnan(torn.data["bound"].values).all()


def test_without_until_a_run_goes_on_until_schedules_have_ended() -> None:
    result = cs.run(cs.loads(TORN), rate=10)
    assert result.summary["rounds"] is not None
    assert result.summary["rounds"] >= 90
    assert result.summary["status"] == "satisfied"


def test_expressions_and_functions_read_the_time() -> None:
    def orbit(a: Any, t: Any) -> Any:
        return 1.0 - jnp.sum((a - 2.0 * jnp.stack([jnp.cos(0.2 * t), jnp.sin(0.2 * t)])) ** 2)

    written = cs.expr("1 - norm2(a - [2*cos(0.2*t), 2*sin(0.2*t)])", name="orbit")
    for constraint in (written, cs.constraint(orbit, reads=("a",), name="orbit")):
        team = cs.Team([cs.Agent("a", [constraint], start=[2, 0])])
        assert team.moves
        result = cs.run(team, rate=10, until=8)
        end = result.data["position"].values[-1, 0]
        assert np.linalg.norm(end - 2 * np.array([np.cos(1.6), np.sin(1.6)])) < 1
        assert result.summary["motion"]["satisfied_share_after"] == 1.0  # type: ignore[index]
    assert cs.loads(cs.dump(cs.Team([cs.Agent("a", [written])]))).team.moves


def test_admm_follows_too() -> None:
    result = cs.run(cs.loads(TORN), protocol="admm", rate=20, until=10)
    margin = result.data["margin"].values
    assert (margin[150:] > 0).sum() > 20
    assert result.summary["status"] == "satisfied"


def test_groups_share_a_schedule() -> None:
    group = cs.Group("a", 3, [cs.within(cs.schedule([0, 5], [[0, 0], [3, 0]]), 1)], spacing=0.1)
    team = cs.Team([group])
    assert team.at(5.0).families[0].parameters["center"].tolist() == [[3.0, 0.0]] * 3
    assert cs.run(team, rate=10, until=6).summary["status"] == "satisfied"
    text = cs.dump(team)
    assert cs.dump(cs.loads(text).team) == text


def test_curvature_is_that_of_every_instant() -> None:
    team = cs.Team([
        cs.Agent("a", [
            cs.within(cs.schedule([0, 1], [[0, 0], [1, 0]]), 1),
            cs.outside(cs.schedule([0, 1], [[0, 0], [1, 0]]), 1),
            cs.expr("1 - (t - 5)*norm2(a)"),
            cs.expr("1 - norm2(a) + t"),
        ])
    ])  # fmt: skip
    concave = shape_of(team).concave
    assert concave.tolist() == [True, False, False, True]


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ({"times": [0, 0], "values": [[0, 0], [1, 1]]}, "times of center must rise, but 0 follows 0"),
        ({"times": [0, 1], "values": [[0, 0]]}, "center has 2 times and 1 value"),
        ({"times": [0, 1], "values": [[0, 0], [1]]}, "center has 1 entry, but must have 2"),
        ({"times": [0, float("inf")], "values": [[0, 0], [1, 1]]}, "times of center hold inf"),
        ({"times": [0, 1]}, "center is a schedule without values"),
        ({"time": [0, 1], "values": [[0, 0], [1, 1]]}, "a schedule has no key 'time'"),
        ({"times": [], "values": []}, "times of center is []"),
    ],
)
def test_a_schedule_that_cannot_be_is_refused_with_the_cure(value: Any, message: str) -> None:
    with pytest.raises(cs.InvalidTeam) as refused:
        cs.Team([cs.Agent("a", [cs.within(value, 1)])])
    assert message in str(refused.value)


def test_what_is_positive_or_points_somewhere_does_so_at_all_times() -> None:
    for constraint, message in (
        (cs.within([0, 0], cs.schedule([0, 1], [1, -1])), "radius is -1"),
        (cs.halfspace(cs.schedule([0, 2], [[1, 0], [-1, 0]]), 1), "normal passes through zero between 0 s and 2 s"),
        (cs.box(cs.schedule([0, 5], [[0, 0], [2, 2]]), [1, 1]), "at 5 s, but must be above low"),
    ):
        with pytest.raises(cs.InvalidTeam, match=message):
            cs.Team([cs.Agent("a", [constraint])])


def test_places_of_faults_in_a_file() -> None:
    with pytest.raises(cs.InvalidScenario) as refused:
        cs.loads(TORN.replace("times: [1, 5, 9]", "times: [1, 9, 5]"), "torn.yaml")
    assert "torn.yaml:10:" in str(refused.value)
    assert "must rise" in str(refused.value)


def test_what_does_not_follow_says_so() -> None:
    team = cs.loads(TORN).team
    with pytest.raises(cs.InvalidSettings, match="flows without rounds"):
        cs.run(team, protocol="gradient-flow", until=5)
    with pytest.raises(cs.InvalidSettings, match="until and rounds both say"):
        cs.run(team, until=5, rounds=10)


def test_a_run_that_is_taken_up_is_where_it_would_have_been(tmp_path: Path) -> None:
    scenario = cs.loads(TORN)
    whole = cs.run(scenario, rate=20, rounds=120)
    cs.run(scenario, rate=20, rounds=60, out=tmp_path, checkpoint=0.0)
    again = cs.resume(tmp_path, rounds=120)
    np.testing.assert_array_equal(again.data["position"].values[-1], whole.data["position"].values[-1])
    assert again.summary["motion"] == whole.summary["motion"]
