"""A run says for how much of it constraints that keep out were violated on the way, however little of it is recorded."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import consat as cs

PILLAR = 1.5
# the protocol whose agents walk straight at their goals
DRIVEN: dict[str, Any] = {"protocol": "admm", "rate": 10, "speed": 0.5}


def corridor() -> cs.Team:
    """A goal behind a pillar, and somebody who stays near."""
    pillar = cs.outside([0, 0], PILLAR, name="pillar")
    robot = cs.Agent("robot", [cs.within([4, 0], 0.5, name="goal"), pillar], start=[-4, 0.1])
    buddy = cs.Agent("buddy", [cs.near("robot", 1.5), cs.apart("robot", 0.5), pillar], start=[-4, -1])
    return cs.Team([robot, buddy])


def told(result: cs.Result) -> dict[tuple[str, str], float | None]:
    agents = result.summary["agents"].items()
    return {(agent, each["name"]): each["violated_share"] for agent, entry in agents for each in entry["constraints"]}


def within_the_pillar(result: cs.Result, agent: str) -> float:
    """The share of the recorded steps at which an agent is no farther from the origin than the pillar reaches."""
    at = result.data["position"].sel(agent=agent).values
    return float(np.mean(np.sum(at**2, axis=1) <= PILLAR**2))


@pytest.fixture(scope="module")
def crossing() -> cs.Result:
    return cs.run(corridor(), **DRIVEN)


def test_a_path_through_a_pillar_is_said(crossing: cs.Result) -> None:
    assert crossing.summary["status"] == "satisfied"
    shares = told(crossing)
    assert shares[("robot", "pillar")] == within_the_pillar(crossing, "robot") > 0.1
    assert shares[("buddy", "pillar")] == within_the_pillar(crossing, "buddy") > 0.3
    between = np.linalg.norm(np.diff(crossing.data["position"].values, axis=1)[:, 0], axis=-1)
    assert shares[("buddy", "apart(robot)")] == np.mean(between <= 0.5)
    # a goal that is not reached yet, and a mate who is not near yet, are no danger
    assert shares[("robot", "goal")] is None
    assert shares[("buddy", "near(robot)")] is None
    worst = max((share, key) for key, share in shares.items() if share is not None)
    assert crossing.summary["on_the_way"] == {
        "watched": 3, "violated": 3, "worst": {"agent": worst[1][0], "constraint": worst[1][1], "violated_share": worst[0]}
    }  # fmt: skip
    assert f"robot: pillar for {shares[('robot', 'pillar')]:.0%}" in str(crossing)
    assert " violated for " in str(crossing)


def test_nothing_is_lost_where_little_is_recorded(crossing: cs.Result, tmp_path: Path) -> None:
    thin = cs.run(corridor(), **DRIVEN, every=50, agents=["buddy"], out=tmp_path / "filed")
    assert told(thin) == told(crossing)
    assert told(cs.Result.load(tmp_path / "filed" / "result.nc")) == told(crossing)


def test_a_run_that_is_taken_up_goes_on_counting(tmp_path: Path) -> None:
    whole = cs.run(corridor(), **DRIVEN, rounds=120)
    cs.run(corridor(), **DRIVEN, rounds=90, out=tmp_path, checkpoint=0.0)
    assert told(cs.resume(tmp_path, rounds=120)) == told(whole)
    assert 0 < told(whole)[("robot", "pillar")] < 1  # type: ignore[operator]


def test_a_flow_counts_too() -> None:
    team = cs.Team([cs.Agent("robot", [cs.within([2, 0], 1), cs.outside([0, 0], PILLAR, name="pillar")], start=[0.5, 0])])
    options: dict[str, Any] = {"protocol": "gradient-flow", "smoothing": cs.Smoothing(nu_alpha=1.0, nu_beta=0.5), "until": 3.0}
    result = cs.run(team, **options)
    assert told(result)[("robot", "pillar")] == within_the_pillar(result, "robot")
    assert 0.01 < within_the_pillar(result, "robot") < 1
    assert told(cs.run(team, every=100, **options)) == told(result)


def test_own_constraints_that_are_not_concave_are_watched_and_a_convex_team_says_nothing() -> None:
    own = cs.expr("norm2(a - b) - 1", name="clear")
    team = cs.Team([cs.Agent("a", [cs.within([0, 0], 3), own], start=[0, 0]), cs.Agent("b", [cs.within([0, 0], 3)], start=[0.1, 0])])
    shares = told(cs.run(team, rounds=10))
    assert shares[("a", "clear")] > 0  # type: ignore[operator]
    assert [shares[key] for key in (("a", "within"), ("b", "within"))] == [None, None]
    convex = cs.run("case-b", rounds=3)
    assert set(told(convex).values()) == {None}
    assert convex.summary["on_the_way"] == {"watched": 0, "violated": 0, "worst": None}
    assert "on the way" not in str(convex)


def test_start_counts_as_a_step() -> None:
    team = cs.Team([cs.Agent("a", [cs.outside([0, 0], 1)], start=[0.5, 0])])
    assert told(cs.run(team, rounds=0)) == {("a", "outside"): 1.0}
