"""A slice of the hunt of `benchmarks/hunt.py`: a few of its random teams through every command, with warnings as errors."""

from __future__ import annotations

import pytest

from benchmarks.hunt import COMMANDS, PROTOCOLS, draw, examine

SEEDS = (11, 12)
"""Few agents and constraints, which compile soonest: a pole, a plateau, kinks, edges of domains; functions and text."""


@pytest.mark.parametrize("seed", SEEDS)
def test_nothing_is_raised_nan_or_false(seed: int) -> None:
    assert examine(draw(seed), tuple(command for command in COMMANDS if command not in PROTOCOLS)).failures == []


def test_the_same_seed_draws_the_same_team() -> None:
    assert draw(5).agents == draw(5).agents
    assert draw(5).agents != draw(6).agents
