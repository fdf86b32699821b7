"""Robots in a run and in a session: they arrive, touch nothing, and the scenario says what they are."""

import numpy as np
import pytest

import consat as cs
from consat.scenario.robots import Robots

CROSSING = """
consat: 1
name: crossing
agents:
  - {id: a, start: [-1, 0], constraints: [{kind: within, center: [1, 0], radius: 0.15, name: goal}]}
  - {id: b, start: [1, 0], robot: {speed: 0.4}, constraints: [{kind: within, center: [-1, 0], radius: 0.15, name: goal}]}
  - {id: c, start: [0, -1], constraints: [{kind: within, center: [0, 1], radius: 0.15, name: goal}]}
robots: {kind: unicycle, radius: 0.1, speed: 0.5, turn_rate: 3.6}
obstacles:
  - {kind: disc, center: [0, 0], radius: 0.25}
rate: 20
"""


@pytest.fixture(scope="module")
def crossing() -> cs.Result:
    return cs.run(cs.loads(CROSSING), until=16)


def test_all_arrive_and_nobody_touches(crossing: cs.Result) -> None:
    summary, motion = crossing.summary, crossing.summary["motion"]
    assert summary["status"] == "satisfied"
    assert motion is not None
    assert motion["contacts"] == 0
    assert motion["smallest_distance"] > 0
    assert motion["clearance"] > 0
    assert motion["stuck"] == []
    assert motion["unproven"] == []
    assert motion["satisfied_share_after"] == 1.0
    assert summary["robots"]["kind"] == "unicycle"  # type: ignore[index]
    assert summary["obstacles"] == [{"kind": "disc", "center": [0.0, 0.0], "radius": 0.25}]


def test_what_is_told_is_what_happened(crossing: cs.Result) -> None:
    """Distances as NumPy finds them from the record: bodies are an offset behind the points that constraints see."""
    motion, position, heading = crossing.summary["motion"], crossing.data["position"].values, crossing.data["heading"].values
    assert motion is not None
    offset = cs.Unicycle().offset
    body = position - offset * np.stack([np.cos(heading), np.sin(heading)], axis=-1)
    pairs = [np.linalg.norm(body[:, i] - body[:, j], axis=1) for i, j in ((0, 1), (0, 2), (1, 2))]
    assert motion["smallest_distance"] == pytest.approx(min(each.min() for each in pairs) - 0.2, abs=1e-6)
    assert motion["clearance"] == pytest.approx(np.linalg.norm(body, axis=2).min() - 0.35, abs=1e-6)
    step = np.linalg.norm(np.diff(body, axis=0), axis=2) * 20
    assert step[:, [0, 2]].max() <= 0.5 + 1e-9
    assert step[:, 1].max() <= 0.4 + 1e-9
    assert np.abs(np.diff(np.unwrap(heading, axis=0), axis=0)).max() * 20 <= 3.6 + 1e-9
    np.testing.assert_allclose(crossing.data["agent_margin"].values[-1], cs.margins(cs.loads(CROSSING).team, position[-1]), atol=1e-12)


def test_conditions_of_the_theorem_that_do_not_hold_are_told() -> None:
    """Wind moves points, which no command asked for, and somebody who is put down on top of another is nearer than the filter keeps."""
    team = cs.Team([cs.Agent(f"a{k}", [cs.within([float(k), 0], 0.3)], start=[float(k), 1.0]) for k in range(2)])
    session = cs.Session(team, robots=cs.Point(radius=0.1), rate=20, wind=(0.1, 0)).step(2)
    assert [each.split(":")[0] for each in session.result().summary["motion"]["unproven"]] == ["wind"]  # type: ignore[index]
    session.place("a1", [0.05, 1.0]).step(2)
    assert [each.split(":")[0] for each in session.result().summary["motion"]["unproven"]] == ["wind", "distance"]  # type: ignore[index]


def test_a_saved_result_keeps_headings(crossing: cs.Result, tmp_path: object) -> None:
    loaded = cs.Result.load(crossing.save(f"{tmp_path}/r.nc"))
    np.testing.assert_array_equal(loaded.data["heading"].values, crossing.data["heading"].values)
    assert loaded.summary["robots"] == crossing.summary["robots"]


def test_a_session_drives_them_too() -> None:
    session = cs.Session(cs.loads(CROSSING)).step(330)
    assert session.satisfied
    assert session.headings is not None
    told = session.result().summary["motion"]
    assert told is not None
    assert told["contacts"] == 0
    session.place("a", [0.5, 1.2]).step(1)
    assert np.linalg.norm(session.positions[0] - [0.5, 1.2]) <= 0.5 / 20 + 1e-9
    session.step(160)
    assert session.satisfied


def test_python_says_the_same_as_a_file() -> None:
    scenario = cs.loads(CROSSING)
    assert scenario.robots is not None
    team = scenario.team
    common = cs.Unicycle(radius=0.1, speed=0.5, turn_rate=3.6)
    robots = {"a": common, "b": cs.Unicycle(radius=0.1, speed=0.4, turn_rate=3.6), "c": common}
    ways = [
        cs.run(team, robots=robots, obstacles=[cs.disc([0, 0], 0.25)], rate=20, rounds=40),
        cs.run(scenario, rounds=40),
    ]
    np.testing.assert_array_equal(*(way.data["position"].values for way in ways))
    text = cs.dump(team, robots=scenario.robots, rate=20.0)
    again = cs.loads(text)
    assert again.rate == 20.0
    assert again.robots is not None
    assert again.robots.data == scenario.robots.data
    assert Robots.of(scenario.robots.data).data == scenario.robots.data


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("kind: unicycle, radius", "kind: unicycel, radius"), "there is no kind 'unicycel'"),
        (("radius: 0.1, speed: 0.5", "radius: -1, speed: 0.5"), "robots, radius: must be positive, but is -1"),
        (("turn_rate", "turnrate"), "there is no key 'turnrate'"),
        (("robot: {speed: 0.4}", "robot: {speed: fast}"), "agent 'b', robot"),
        (("kind: disc, center: [0, 0], radius: 0.25", "kind: polygon, vertices: [[0, 0], [1, 1], [1, 0], [0, 1]]"), "cross"),
        (("center: [0, 0], radius: 0.25", "center: [0, 0, 0], radius: 0.25"), "obstacles[0]"),
        (("center: [0, 0], radius: 0.25", "center: [0.9, 0], radius: 0.25"), "inside one"),
        (("start: [1, 0]", "start: [-0.9, 0]"), "their bodies overlap"),
        (("rate: 20", "rate: 0"), "rate is 0, but must be a positive number"),
        (("rate: 20", "dimension: 3"), "dimensions"),
    ],
)
def test_faults_have_a_place_and_a_cure(change: tuple[str, str], message: str) -> None:
    with pytest.raises(cs.InvalidScenario) as refused:
        cs.loads(CROSSING.replace(*change), "crossing.yaml")
    text = str(refused.value)
    assert message in text
    assert all(line.startswith("crossing.yaml:") for line in text.splitlines())


def test_goals_in_obstacles_are_named() -> None:
    from consat.scenario.robots import blocked_goals

    goals = [
        cs.Agent("a", [cs.within([3, 0], 0.3, name="goal")]),
        cs.Agent("b", [cs.within([2, 0.9], 1.5)]),
        cs.Agent("c", [cs.within([0, 0], 1), cs.within(cs.schedule([0, 5], [[0, 0], [9, 9]]), 0.2, name="later")]),
    ]
    stand = (cs.disc([9, 9], 1), cs.polygon([[2, -1], [4, -1], [4, 1], [2, 1]]))
    robots = Robots(cs.Unicycle(radius=0.1), {}, stand)
    assert blocked_goals(robots, cs.Team(goals)) == [
        "agent 'a', constraint 'goal': no point of the goal is clear of obstacles[1] (polygon) by the radius of the robot",
        "agent 'b', constraint 'within': the centre of the goal is not clear of obstacles[1] (polygon) by the radius of the robot",
        "agent 'c', constraint 'later': no point of the goal is clear of obstacles[0] (disc) by the radius of the robot",
    ]
    assert blocked_goals(Robots(cs.Point(radius=0.1)), cs.Team(goals)) == []
    found = cs.run(cs.Team(goals), robots=robots.common, obstacles=robots.obstacles, rate=10, until=0.5).summary["warnings"]
    assert set(blocked_goals(robots, cs.Team(goals))) <= set(found)


def test_obstacles_without_robots_are_a_fault() -> None:
    with pytest.raises(cs.InvalidScenario, match="no robots to keep clear of them"):
        cs.loads(CROSSING.replace("robots: {", "# {").replace("robot: {speed: 0.4}, ", ""))
    team = cs.Team([cs.Agent("a", [cs.within([0, 0], 1)])])
    with pytest.raises(cs.InvalidInput, match="is no robot"):
        cs.run(team, robots=3)
    with pytest.raises(cs.InvalidSettings, match="wind, noise and simulator mean something to robots only"):
        cs.run(team, wind=(1, 0))
    with pytest.raises(cs.InvalidSettings, match="robots have a speed of their own"):
        cs.run(team, robots=cs.Point(), rate=10, speed=1.0)


def test_starts_that_are_drawn_do_not_overlap() -> None:
    team = cs.Team([cs.Agent(f"a{k}", [cs.within([0.5 * k, 0], 0.3)]) for k in range(6)])
    result = cs.run(team, robots=cs.Point(radius=0.15), start=(-0.2, 0.2), rate=20, rounds=1)
    first = result.data["position"].values[0]
    apart = np.linalg.norm(first[:, None] - first[None], axis=2)[np.triu_indices(6, 1)]
    assert apart.min() >= 0.3
