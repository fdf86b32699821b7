"""Robots on a network: commands (v, ω), filtered against what each measures near it; they stand when they must."""

import numpy as np
import pytest

import consat as cs
from consat.errors import InvalidSettings
from consat.network.node.body import Measurement
from consat.network.node.orders import Orders
from consat.network.node.part import read_part, split, write_part
from consat.network.node.pilot import HELD, RobotBody
from consat.numerics import float64
from consat.scenario.robots import Robots

TICK = 0.05


def moved(pose: np.ndarray, v: float, omega: float, seconds: float) -> np.ndarray:
    """(x, y, θ) on an arc, in small steps."""
    for _ in range(20):
        pose = pose + seconds / 20 * np.array([v * np.cos(pose[2]), v * np.sin(pose[2]), omega])
    return pose


@float64
def test_two_unicycles_pass_each_other_and_an_obstacle_each_by_itself() -> None:
    """They decide by turns, not at once, and each holds its command for two ticks."""
    robots = Robots(cs.Unicycle(radius=0.1, speed=0.5), {}, (cs.disc([0.0, 0.05], 0.15),))
    poses = [np.array([-1.0, 0.0, 0.0]), np.array([1.0, 0.02, np.pi])]
    goals = [np.array([1.0, 0.0]), np.array([-1.0, 0.02])]
    bodies, commands = [RobotBody(robots, 2, 0.5) for _ in poses], [{"v": 0.0, "omega": 0.0}] * 2
    gap, clear, turned = np.inf, np.inf, 0.0
    for tick in range(280):
        now, i = 10.0 + TICK * tick, tick % 2
        seen = Measurement(poses[i][:2], now, None, poses[i][2], poses[1 - i][None, :2])
        assert bodies[i].measure(seen) is None
        commands[i] = bodies[i].named(bodies[i].command(goals[i], now))
        poses = [moved(pose, command["v"], command["omega"], TICK) for pose, command in zip(poses, commands, strict=True)]
        turned = max(turned, *(abs(command["omega"]) for command in commands))
        gap = min(gap, float(np.linalg.norm(poses[0][:2] - poses[1][:2])) - 0.2)
        clear = min(clear, *(float(np.linalg.norm(pose[:2] - [0.0, 0.05])) - 0.25 for pose in poses))
    assert gap > 0
    assert clear > 0
    assert 0.5 < turned <= 3.6 + 1e-9
    for pose, goal in zip(poses, goals, strict=True):
        assert np.linalg.norm(pose[:2] + 0.05 * np.array([np.cos(pose[2]), np.sin(pose[2])]) - goal) < 0.1


@float64
def test_a_robot_stands_where_it_is_not_measured_and_says_what_is_missing() -> None:
    body = RobotBody(Robots(cs.Unicycle()), 2, 0.5)
    target = np.array([1.0, 0.0])
    assert body.valid == HELD
    assert body.named(body.command(target, 0.0)) == {"v": 0.0, "omega": 0.0}
    here = np.zeros(2)
    assert "heading is missing" in str(body.measure(Measurement(here, 1.0, None, None, np.zeros((0, 2)))))
    assert "neighbours is missing" in str(body.measure(Measurement(here, 1.0, None, 0.0)))
    assert body.measure(Measurement(here, 1.0, None, 0.0, np.zeros((0, 2)))) is None
    assert body.named(body.command(target, 1.1))["v"] == pytest.approx(0.5)
    assert body.named(body.command(target, 1.6)) == {"v": 0.0, "omega": 0.0}
    assert body.measure(Measurement(here, 2.0, None, 0.0, np.array([[0.31, 0.0]]))) is None
    assert body.named(body.command(target, 2.0))["v"] * HELD <= 0.25 * (0.31 - 0.2), (
        "half of its half of the gap: others may have begun to move"
    )
    with pytest.raises(InvalidSettings, match="a double cannot halt at once; on a network point and unicycle are driven"):
        RobotBody(Robots(cs.Double()), 2, 0.5)


def test_measurements_tell_of_heading_and_neighbours() -> None:
    orders = Orders(2, reading=False)
    assert orders._take('{"position": [1, 2], "heading": 0.5, "neighbours": [[0, 1], [3, 4]]}') is None
    ((_, new),) = orders.measurements()
    assert new.heading == 0.5
    np.testing.assert_array_equal(new.neighbours, [[0, 1], [3, 4]])
    assert orders._take('{"position": [1, 2], "heading": "north"}') == "heading must be a finite number, rad"
    for wrong in ("3", "[1, 2]", "[[1]]", '[[1, "a"]]'):
        assert orders._take(f'{{"position": [1, 2], "neighbours": {wrong}}}') == "neighbours must be a list of lists of 2 finite numbers"


def test_a_part_has_its_own_robot_and_the_map_and_no_other_robots() -> None:
    scenario = cs.loads(
        "consat: 1\nagents:\n"
        "  - {id: a, start: [0, 0], constraints: [{kind: within, center: [1, 0], radius: 1}, {kind: near, agent: b, radius: 3}]}\n"
        "  - {id: b, start: [3, 0], robot: {speed: 0.25}}\n"
        "robots: {kind: unicycle, radius: 0.2}\nobstacles: [{kind: disc, center: [0, 2], radius: 1}]\n"
    )
    for agent, speed in (("a", 0.5), ("b", 0.25)):
        text = write_part(split(scenario)[agent])
        part = read_part(text, "part")
        assert part.robots is not None
        assert part.robots.own == {}
        assert isinstance(part.robots.common, cs.Unicycle)
        assert (part.robots.common.speed, part.robots.common.radius) == (speed, 0.2)
        assert part.robots.obstacles == (cs.disc([0, 2], 1),)
        assert ("0.25" in text) == (agent == "b")
