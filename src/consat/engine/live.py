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
            {
                key: array if (track := tracks.get(key)) is None else jnp.asarray(array).at[track.rows].set(track.at(time, jnp))
                for key, array in own.items()
            }
            for own, tracks in zip(self.parameters, self.tracks, strict=True)
        )
