"""Sequences of ids and names that are built on access: those of a million agents take no memory."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Iterable, Iterator, Sequence
from typing import overload

import numpy as np


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
