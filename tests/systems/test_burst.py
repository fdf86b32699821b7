"""Losses in bursts."""

import numpy as np
import pytest

import consat as cs
from consat.faults import Faults


def test_a_team_gets_through_bursts_and_the_share_that_is_lost_is_that_of_the_chain() -> None:
    whole = cs.run("case-c", rounds=60)
    rough = cs.run("case-c", burst=(0.1, 0.2), rounds=60, seed=3)
    assert rough.summary["status"] == "satisfied"
    assert not np.array_equal(rough.data["position"].values, whole.data["position"].values)
    again = cs.run("case-c", burst=(0.1, 0.2), rounds=60, seed=3)
    np.testing.assert_array_equal(again.data["position"].values, rough.data["position"].values)
    never = cs.run("case-c", burst=(1.0, 1e-9), rounds=60, seed=3)  # bad from the first round on
    alone = cs.run("case-c", loss=0.999999, rounds=60, seed=3)
    np.testing.assert_allclose(never.data["position"].values[-1], alone.data["position"].values[-1], atol=1e-9)


@pytest.mark.parametrize("burst", [(0.0, 0.5), (0.1, 1.5), (0.1,)])
def test_what_are_no_probabilities_is_refused(burst: tuple[float, ...]) -> None:
    with pytest.raises(cs.InvalidSettings, match="two probabilities"):
        cs.run("case-c", burst=burst, rounds=1)  # type: ignore[arg-type]


def test_no_burst_is_the_same_as_before() -> None:
    assert Faults() == Faults(0.0, 0.0, 0, None)
