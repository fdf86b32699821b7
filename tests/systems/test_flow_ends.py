"""Flows that cannot go on stop at numbers, before anything overflows, and say what would help."""

from __future__ import annotations

import re

import numpy as np
import pytest

import consat as cs
from consat.engine import flows

SMOOTHING = cs.Smoothing(nu_alpha=5, nu_beta=5)


def no_nan(result: cs.Result) -> bool:
    """Whether everything that was recorded is a number, but for margins that are −∞."""
    trace = result._trace
    assert trace is not None
    recorded = (trace.position, trace.velocity, trace.estimate, trace.integral, trace.margin, trace.smooth_margin, trace.agent_margin)
    return not any(np.isnan(values).any() for values in recorded if values is not None)


def test_what_overflows_at_its_start_stays_there_and_each_cure_can_be_typed() -> None:
    """f = e^(5 · 10⁸) has no slope that a step could be taken along."""
    result = cs.run("case-a", protocol="gradient-flow", start=(-1e4, 1e4), smoothing=SMOOTHING, until=10.0)
    assert result.summary["status"] == "diverged"
    assert result.summary["time"] == 0.0
    assert no_nan(result)
    assert np.abs(list(result.summary["positions"].values())).max() <= 1e4
    (warning,) = result.summary["warnings"]
    assert "The flow diverged at t = 0 s" in warning
    for wanted in ("a smaller nu", "a ramp of nu_beta", "a protocol in rounds (--protocol"):
        assert wanted in warning
    smaller, ramp = (cs.load("case-a", [text]).settings.smoothing for text in re.findall(r"--set '([^']*)'", warning))
    assert isinstance(smaller, cs.Smoothing)
    assert smaller.nu_beta == pytest.approx(0.5)
    assert isinstance(ramp, cs.Smoothing)
    assert isinstance(ramp.nu_beta, cs.Ramp)
    assert ramp.nu_beta.to == 5
    assert warning in str(result)


@pytest.mark.parametrize("every", [1, 7])
def test_what_goes_astray_is_stopped_at_its_last_sample_and_state(every: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """A limit that this flow passes on its way to x = 2 stands for one that a diverging flow passes."""
    whole = cs.run("case-a", protocol="gradient-flow", seed=1, start=(0, 0.5), until=10.0)
    monkeypatch.setattr(flows, "ASTRAY", 0.2)
    result = cs.run("case-a", protocol="gradient-flow", seed=1, start=(0, 0.5), until=10.0, every=every)
    trace, summary = result._trace, result.summary
    assert trace is not None
    assert whole._trace is not None
    assert summary["status"] == "diverged"
    assert 0 < summary["time"] < 10
    assert no_nan(result)
    assert np.all(np.diff(trace.steps) > 0)
    same = np.isin(trace.steps, whole._trace.steps)
    np.testing.assert_allclose(trace.position[same], whole._trace.position[np.isin(whole._trace.steps, trace.steps)], atol=1e-5)
    np.testing.assert_array_equal(trace.position[-1], list(summary["positions"].values()))
    assert summary["margin"] == pytest.approx(float(trace.margin[-1]))
    assert f"The flow diverged at t = {summary['time']:.4g} s" in summary["warnings"][0]
