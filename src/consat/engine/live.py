"""Constraint parameters that change during a run, because they follow a schedule or because a session sets them.

They are arguments of the compiled program, not constants in it, so that a change does not cause a compilation.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from consat.problem.schedule import Track
from consat.problem.team import Team

Values = tuple[Mapping[str, Array], ...]
"""For each family its changeable parameters, name to (M_f, …)."""


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Live:
    """Changeable parameters of a team's constraints.

    Attributes:
        parameters: values at time 0, or as last set.
        tracks: for each family the schedules of its moving parameters.
        period: () duration of a round, s.
    """

    parameters: Values
    tracks: tuple[Mapping[str, Track], ...]
    period: Array

    @classmethod
    def of(cls, team: Team, period: float, *, all_of_them: bool) -> Live | None:
        """The changeable parameters of a team; None without any.

        Args:
            team: the team.
            period: duration of a round, s.
            all_of_them: whether every parameter may be set; else only those that move.
        """
        if not (all_of_them or team.moves):
            return None
        kept: list[Mapping[str, Any]] = []
        for family in team.families:
            names = [key for key in family.parameters if all_of_them or key in family.tracks]
            kept.append({key: np.array(family.parameters[key], dtype=float) for key in names})
        tracks = tuple({key: jax.tree.map(jnp.asarray, track) for key, track in family.tracks.items()} for family in team.families)
        return cls(tuple(kept), tracks, jnp.asarray(float(period)))

    def at(self, round_: Array) -> Values:
        """The parameters at time `round_` · `period`. `round_`: () number of finished rounds."""
        time = round_ * self.period
        return tuple(
            {key: array if (track := tracks.get(key)) is None else _moved(jnp.asarray(array), track, time) for key, array in own.items()}
            for own, tracks in zip(self.parameters, self.tracks, strict=True)
        )


def _moved(array: Array, track: Track, time: Array) -> Array:
    """The parameter, (M_f, …), with the rows that move set to their values at `time`, s (piecewise linear)."""
    times, values = track.times, track.values
    last = times.shape[1] - 1
    k = jnp.maximum(jnp.sum((times <= time).astype(jnp.int32), axis=1) - 1, 0)
    row = jnp.arange(len(k), dtype=k.dtype)
    after = jnp.minimum(k + 1, last)
    here, gap = times[row, k], times[row, after] - times[row, k]
    moving = (gap > 0) & jnp.isfinite(gap)
    part = jnp.clip(jnp.where(moving, (time - here) / jnp.where(moving, gap, 1.0), 0.0), 0.0, 1.0)
    low, high = values[row, k], values[row, after]
    return array.at[track.rows].set(low + part.reshape(-1, *[1] * (low.ndim - 1)) * (high - low))
