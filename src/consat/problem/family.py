"""Families: constraints that share one function, with stacked parameters."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from consat.problem.names import Chosen, Joined
from consat.problem.schedule import Track


@dataclass(frozen=True, eq=False)
class Family:
    """M constraints that share one function ψ, with stacked parameters; evaluated by one `jax.vmap`.

    Attributes:
        kind: the name that errors and reports use.
        psi: ``psi(*positions, **parameters) -> scalar``.
        agents: (M, arity) indices of the agents whose positions ψ takes.
        owner: (M,) index of the agent that owns each constraint.
        number: (M,) index of each constraint in the team's order, which is sorted by owner.
        parameters: arrays with leading axis M. Moving parameters have their value at time 0.
        weight: (M,) positive factors on ψ.
        sources: (M,) the text expressions; None if not all constraints were written as text.
        tracks: trajectories of the parameters that move with time, by parameter name.
    """

    kind: str
    psi: Callable[..., Any]
    agents: np.ndarray
    owner: np.ndarray
    number: np.ndarray
    parameters: Mapping[str, np.ndarray]
    weight: np.ndarray
    sources: Sequence[str] | None = None
    tracks: Mapping[str, Track] = field(default_factory=dict)

    def members(self, which: np.ndarray) -> Family:
        """A subset of the constraints, which keep their `number`.

        Args:
            which: (M,) boolean mask, or ascending indices.
        """
        rows = np.flatnonzero(which) if which.dtype == bool else which
        tracks = {key: kept for key, track in self.tracks.items() if (kept := track.chosen(rows)) is not None}
        return replace(
            self, agents=self.agents[rows], owner=self.owner[rows], number=self.number[rows], weight=self.weight[rows],
            parameters={key: value[rows] for key, value in self.parameters.items()},
            sources=None if self.sources is None else Chosen(self.sources, rows), tracks=tracks,
        )  # fmt: skip

    def at(self, time: float) -> Family:
        """The family with its parameters frozen at `time`, s."""
        if not self.tracks:
            return self
        moving = {key: _written(self.parameters[key], track.rows, track.at(time)) for key, track in self.tracks.items()}
        return replace(self, parameters={**self.parameters, **moving}, tracks={})

    @property
    def lasting(self) -> Mapping[str, np.ndarray]:
        """The parameters, with NaN where they move with time. What is proven from these, such as curvature, holds at all times."""
        moving = {key: _written(self.parameters[key], track.rows, np.nan) for key, track in self.tracks.items()}
        return {**self.parameters, **moving}

    @property
    def size(self) -> int:
        """M, the number of constraints."""
        return len(self.owner)

    @property
    def arity(self) -> int:
        """Number of positions that ψ takes."""
        return int(self.agents.shape[1])


def assemble(parts: Sequence[tuple[Family, Sequence[str]]]) -> tuple[tuple[Family, ...], np.ndarray, Sequence[str]]:
    """Merges families that have the same function and the same shapes of parameters, and numbers the constraints by owner.

    Args:
        parts: families, each with the (M,) names of its constraints. Their `number` is a rank, by which the constraints of one owner are
            sorted; it may have gaps.

    Returns:
        the families, the (M,) owners and the (M,) names, both in the team's order.
    """
    nothing = np.zeros(0, dtype=np.int32)
    owner = np.concatenate([nothing, *(family.owner for family, _ in parts)])
    rank = np.concatenate([nothing, *(family.number for family, _ in parts)])
    order = np.lexsort((rank, owner)).astype(np.int32)
    number = np.empty(len(owner), dtype=np.int32)
    number[order] = np.arange(len(owner))
    starts = np.cumsum([0, *(family.size for family, _ in parts)])
    alike: dict[tuple[Any, ...], list[Family]] = {}
    for start, (family, _) in zip(starts, parts, strict=False):
        shapes = tuple((key, value.shape[1:]) for key, value in sorted(family.parameters.items()))
        numbered = replace(family, number=number[start : start + family.size])
        alike.setdefault((family.psi, family.arity, shapes), []).append(numbered)
    return tuple(map(_merged, alike.values())), owner[order], Chosen(Joined([names for _, names in parts]), order)


def _merged(parts: Sequence[Family]) -> Family:
    """The constraints of several families with one function, as one family."""
    if len(parts) == 1:
        return parts[0]
    first = parts[0]
    texts = [part.sources for part in parts if part.sources is not None]
    starts = np.cumsum([0, *(part.size for part in parts)]).tolist()
    moving = {
        key: [(part.tracks[key], start) for part, start in zip(parts, starts, strict=False) if key in part.tracks]
        for key in first.parameters
    }
    return Family(
        kind=first.kind,
        psi=first.psi,
        agents=np.concatenate([part.agents for part in parts]),
        owner=np.concatenate([part.owner for part in parts]),
        number=np.concatenate([part.number for part in parts]),
        parameters={key: np.concatenate([part.parameters[key] for part in parts]) for key in first.parameters},
        weight=np.concatenate([part.weight for part in parts]),
        sources=Joined(texts) if len(texts) == len(parts) else None,
        tracks={key: Track.joined(tracks) for key, tracks in moving.items() if tracks},
    )


def _written(values: np.ndarray, rows: np.ndarray, new: Any) -> np.ndarray:
    changed = np.array(values, dtype=float)
    changed[rows] = new
    return changed
