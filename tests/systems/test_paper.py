"""The paper's runs: the flows against an independent integration, and both layouts of estimates against each other."""

from __future__ import annotations

import numpy as np
import pytest
from tests import paper

import consat as cs

RUN = {"until": 300.0, "record": True}


@pytest.mark.parametrize("case", paper.CASES)
@pytest.mark.parametrize("protocol", ["gradient-flow", "proportional-integral"])
def test_flow_matches_independent_integration(case: str, protocol: str) -> None:
    data = cs.run(case, protocol=protocol, estimates="full", seed=3, **RUN).data
    chosen = data.isel(time=slice(0, None, 100))
    first = data["estimate"].values[0].reshape(3, 3, 2)
    estimates, integrals = paper.integrate(case, protocol, first, chosen["time"].values)
    # rtol 1e-6 a step on paths that contract: the issue asks for 1e-4
    assert np.abs(chosen["estimate"].values.reshape(-1, 3, 3, 2) - estimates).max() < 1e-4
    assert np.abs(chosen["integral"].values.reshape(-1, 3, 3, 2) - integrals).max() < 1e-4


@pytest.mark.parametrize("case", ["case-a", "case-b", "case-c", "case-d"])
def test_local_and_full_estimates_end_at_the_same_optimum(case: str) -> None:
    full, local = (cs.run(case, protocol="gradient-flow", estimates=layout, seed=1, **RUN).data for layout in ("full", "local"))
    assert np.abs(full["position"].values[-1] - local["position"].values[-1]).max() < 5e-3
