"""Families: constraints that share one function, with stacked parameters. Also sequences of ids and names that are built on access."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, overload

import numpy as np

from consat.problem.schedule import Track, chosen


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
        return replace(
            self, agents=self.agents[rows], owner=self.owner[rows], number=self.number[rows], weight=self.weight[rows],
            parameters={key: value[rows] for key, value in self.parameters.items()},
            sources=None if self.sources is None else Chosen(self.sources, rows), tracks=chosen(self.tracks, rows),
        )  # fmt: skip

    def at(self, time: float) -> Family:
        """The family with its parameters frozen at `time`, s."""
        return replace(self, parameters=self.parameters_at(time), tracks={}) if self.tracks else self

    def parameters_at(self, time: float) -> Mapping[str, np.ndarray]:
        """The parameters at `time`, s; arrays as in `parameters`."""
        return {
            **self.parameters,
            **{key: _written(self.parameters[key], track.rows, track.at(time)) for key, track in self.tracks.items()},
        }

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


def distinct(keys: np.ndarray) -> np.ndarray:
    """The distinct integers, sorted. For millions of keys several times as fast as `numpy.unique`.

    Args:
        keys: (K,) integers.
    """
    rising = np.all(keys[1:] >= keys[:-1])
    ordered = keys if rising else np.sort(keys)
    new = np.ones(len(ordered), dtype=bool)
    np.not_equal(ordered[1:], ordered[:-1], out=new[1:])
    return ordered if new.all() else ordered[new]


class Texts(Sequence[str]):
    """A sequence of texts that are built on access. Equal to any sequence with the same texts."""

    @abstractmethod
    def text(self, index: int) -> str:
        """The text at `index`, which the caller has checked to be in range."""

    @overload
    def __getitem__(self, index: int) -> str: ...
    @overload
    def __getitem__(self, index: slice) -> Sequence[str]: ...
    def __getitem__(self, index: int | slice) -> str | Sequence[str]:
        if isinstance(index, slice):
            return tuple(self.text(i) for i in range(*index.indices(len(self))))
        place = int(index) + (len(self) if index < 0 else 0)
        if not 0 <= place < len(self):
            raise IndexError(f"there are {len(self)} texts, but number {index} was asked for")
        return self.text(place)

    def __iter__(self) -> Iterator[str]:
        return map(self.text, range(len(self)))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Sequence) and len(self) == len(other) and all(a == b for a, b in zip(self, other, strict=True))

    __hash__ = None  # type: ignore[assignment]

    def __repr__(self) -> str:
        few = ", ".join(map(repr, self[:3]))
        return f"<{len(self)} texts: {few}{', …' if len(self) > 3 else ''}>"


class Joined(Texts):
    """Concatenation of several sequences."""

    def __init__(self, parts: Iterable[Sequence[str]]) -> None:
        self.parts = tuple(parts)
        self.starts = np.cumsum([0, *map(len, self.parts)])

    def __len__(self) -> int:
        return int(self.starts[-1])

    def text(self, index: int) -> str:
        part = int(np.searchsorted(self.starts, index, side="right")) - 1
        return self.parts[part][index - int(self.starts[part])]

    def __iter__(self) -> Iterator[str]:
        for part in self.parts:
            yield from part


class Chosen(Texts):
    """Selected entries of a sequence: `of[order[0]]`, `of[order[1]]`, …"""

    def __init__(self, of: Sequence[str], order: np.ndarray) -> None:
        self.of, self.order = of, order

    def __len__(self) -> int:
        return len(self.order)

    def text(self, index: int) -> str:
        return self.of[int(self.order[index])]


class Counted(Texts):
    """A stem followed by a number from 1 to `count`: a1, a2, …"""

    def __init__(self, stem: str, count: int) -> None:
        self.stem, self.size = stem, count

    def __len__(self) -> int:
        return self.size

    def text(self, index: int) -> str:
        return f"{self.stem}{index + 1}"

    def find(self, text: object) -> int | None:
        """The index of a text in this sequence; None if it is not in it."""
        if not isinstance(text, str) or not text.startswith(self.stem):
            return None
        digits = text[len(self.stem) :]
        whole = digits.isascii() and digits.isdigit() and digits[0] != "0" and len(digits) < 16
        return int(digits) - 1 if whole and int(digits) <= self.size else None


class Derived(Texts):
    """Names of M constraints: a stem, the other agents that ψ reads, and a number if the name would repeat, as in ``near(a2) #2``.

    Args:
        stem: the name that the user gave, or the kind.
        ids: ids of the team; None to leave the other agents out of the name.
        others: (M, k) indices of the agents read besides the owner.
        rank: (M,) number of earlier constraints of the same owner with the same name; None if no name repeats.
    """

    def __init__(self, stem: str, ids: Sequence[str] | None, others: np.ndarray, rank: np.ndarray | None) -> None:
        self.stem, self.ids, self.others, self.rank = stem, ids, others, rank

    def __len__(self) -> int:
        return len(self.others)

    def text(self, index: int) -> str:
        ids, others = self.ids, self.others[index].tolist()
        base = self.stem if ids is None or not others else f"{self.stem}({', '.join(ids[other] for other in others)})"
        again = 0 if self.rank is None else int(self.rank[index])
        return f"{base} #{again + 1}" if again else base
