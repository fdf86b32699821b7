"""Agents that send only what is news."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import consat as cs
from consat.certify.optimum import max_min
from consat.protocols import sending
from consat.scenario import load


def both(name: str, *overrides: str, **how: Any) -> tuple[dict[str, Any], dict[str, Any]]:
    """The summaries of a run that sends all, and of one that sends what is news."""
    scenario = load(name, overrides)
    every, news = (cs.run(scenario, seed=1, sends=sends, **how).summary for sends in ("all", "events"))
    return every, news


def test_a_chain_is_as_soon_satisfied_and_known_to_be_with_fewer_messages_and_bytes() -> None:
    every, news = both("convoy", "count=20", rounds=80)
    assert news["status"] == "satisfied"
    assert news["satisfied_from"] == every["satisfied_from"]
    assert abs(news["known_from"] - every["known_from"]) <= 2
    assert every["messages"] == 80 * 2 * 19
    assert 3 * news["messages"] < every["messages"]
    assert 4 * news["bytes"] < every["bytes"]
    assert every["bytes"] == sending.HEADER * every["messages"] + 8 * every["floats_sent"]


def test_a_torn_team_is_known_to_be_so_and_ends_at_its_best_margin() -> None:
    scenario = load("case-d")
    best = max_min(scenario.team).margin
    found = cs.run(scenario, protocol="max-min", sends="events")
    assert found.summary["known"] == "infeasible"
    assert found.summary["margin"] == pytest.approx(best, abs=1e-3)
    bound = found.data["bound"].values
    assert np.nanmin(bound) >= best - 1e-9, "no bound is ever below the best margin"


@pytest.mark.parametrize("protocol", ["interior-point", "admm"])
def test_through_loss_and_sleep_silence_is_repaired(protocol: str) -> None:
    found = cs.run("case-c", protocol=protocol, sends="events", loss=0.4, sleep=0.2, seed=3).summary
    assert found["status"] == "satisfied"
    assert found["known"] == "satisfied"


def test_who_is_silent_is_heard_as_before() -> None:
    """P-EXTRA forgives no difference between what is held at both ends of a link: it sends whatever changed, and arrives all the same."""
    every, news = (cs.run("case-c", protocol="proximal", rounds=60, sends=sends) for sends in ("all", "events"))
    np.testing.assert_array_equal(every.data["position"].values, news.data["position"].values)


def test_a_session_at_rest_is_silent_and_speaks_when_a_goal_moves() -> None:
    session = cs.Session(load("convoy", ["count=12"]), seed=0, sends="events").step(400)
    before = session.result().summary["messages"]
    session.step(50)
    rest = session.result().summary["messages"] - before
    assert rest <= 0.02 * 50 * 22
    session.change("a1", "goal", center=[2.1, 0.0]).step(50)
    assert session.satisfied
    assert session.known == "satisfied"
    assert 0 < session.result().summary["messages"] - before - rest <= 0.2 * 50 * 22


def test_a_run_goes_on_to_the_last_bit_from_a_checkpoint(tmp_path: Path) -> None:
    how: Any = {"sends": "events", "loss": 0.2, "seed": 3}
    whole = cs.run("case-c", rounds=40, **how)
    cs.run("case-c", rounds=20, out=tmp_path, checkpoint=0, **how)
    gone_on = cs.resume(tmp_path, rounds=40)
    np.testing.assert_array_equal(gone_on.data["position"].values[-1], whole.data["position"].values[-1])
    assert gone_on.summary["bytes"] == whole.summary["bytes"]


def test_members_that_come_hear_from_everybody() -> None:
    session = cs.Session("case-c", seed=0, sends="events").step(100)
    session.add(cs.Agent("a4", [cs.near("a3", 1)]), links=["a3"]).step(60)
    assert session.satisfied
    assert session.known == "satisfied"


def test_32_bits_are_nearest_and_never_infinite() -> None:
    with jax.enable_x64(True):
        rounded = np.asarray(sending.single(jnp.array([0.1, -1e300, jnp.inf, 1.0])))
    assert rounded.tolist() == [float(np.float32(0.1)), -float(np.finfo(np.float32).max), np.inf, 1.0]


@pytest.mark.parametrize(
    ("how", "message"),
    [({"sends": "some"}, "must be one of all, events"), ({"sends": "events", "protocol": "gradient-flow"}, "sends means nothing to it")],
)
def test_what_cannot_be_is_refused(how: dict[str, Any], message: str) -> None:
    with pytest.raises(cs.InvalidSettings, match=message):
        cs.run("case-c", **how)
