"""How mail of `consat.protocols.local.interior` is written as the numbers of a message: of symmetric matrices the triangle alone, and of
all only what two neighbours share.

    changes, μ, t, least margin, then upper triangle and vector of the quadratic; Σλ, c, error, then triangle and vector of the proof

A message has the same length whoever is there; what belongs to those who have gone is 0.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from consat.network.node.core import LARGEST
from consat.network.node.membership import MOST
from consat.network.node.part import Neighbour, Part
from consat.network.wire import Numbers
from consat.protocols.local.interior import Mail, Proof

INDEFINITE: Final = 1e-6
"""A quadratic is refused of which an eigenvalue is below zero by more than this part of the largest: rounding leaves less."""
HEAD: Final = 4
"""Numbers before the quadratic: changes, μ, t and the least margin."""
TAIL: Final = 3
"""Numbers before that of the proof: Σλ, c and the error."""


class Letter(NamedTuple):
    """What a message to one neighbour consists of.

    Attributes:
        names: whose coordinates are shared, each d times, and last None for the level, if it is.
        level: whether it is.
    """

    names: tuple[tuple[str, int] | None, ...]
    level: bool

    @classmethod
    def of(cls, neighbour: Neighbour, dimension: int) -> Letter:
        """Of a neighbour, in a space of so many dimensions."""
        places = [(agent, axis) for agent in neighbour.travels for axis in range(dimension)]
        return cls((*places, *[None] * neighbour.level), neighbour.level)

    @property
    def size(self) -> int:
        """p."""
        return len(self.names)

    @property
    def length(self) -> int:
        """How many numbers."""
        return HEAD + _both(self.size) + TAIL + _both(self.size - self.level)

    @property
    def weight(self) -> int:
        """The place of Σλ, with which the proof begins."""
        return HEAD + _both(self.size)

    def numbers(self) -> Numbers:
        """What such a message must be."""
        return Numbers((self.length,), tuple(self._largest().tolist()), functools.partial(sound, self.size, self.level))

    def _largest(self) -> np.ndarray:
        largest = np.full(self.length, LARGEST)
        largest[0], largest[3] = MOST, np.inf
        return largest

    def brief(self) -> tuple[Numbers, Numbers]:
        """What its halves must be, see `halves`, where few bytes count."""
        short, rest = (tuple(half.tolist()) for half in halves(self._largest(), self.weight))
        return (
            Numbers((len(short),), short, functools.partial(_quadratic_sound, self.size), single=True),
            Numbers((len(rest),), rest, functools.partial(_proof_sound, self.size - self.level)),
        )


def halves(row: np.ndarray, weight: int) -> tuple[np.ndarray, np.ndarray]:
    """Of a message the numbers that may be rounded, μ, t, the least margin and the quadratic; and count and proof, which may not."""
    return row[1:weight], np.concatenate([row[:1], row[weight:]])


def whole(short: np.ndarray, rest: np.ndarray) -> np.ndarray:
    """The message of two halves."""
    return np.concatenate([rest[:1], short, rest[1:]])


def _both(size: int) -> int:
    """Numbers of a triangle and a vector."""
    return size * (size + 1) // 2 + size


def sound(size: int, level: bool, numbers: np.ndarray) -> bool:
    """Whether a message of p = `size` shared variables is one that an agent of sense can have sent: both quadratics positive semidefinite
    within rounding, a count that is one, no weight and no barrier negative, but −1 where nothing is said."""
    short, rest = halves(numbers, HEAD + _both(size))
    return _quadratic_sound(size, short) and _proof_sound(size - level, rest)


def _quadratic_sound(size: int, numbers: np.ndarray) -> bool:
    barrier = numbers[0]
    return bool(barrier >= 0 or barrier == -1) and _semidefinite(numbers[HEAD - 1 :], size)


def _proof_sound(size: int, numbers: np.ndarray) -> bool:
    changes, weight, _, error = numbers[: 1 + TAIL]
    return bool(
        changes >= 0 and changes == int(changes) and (weight >= 0 or weight == -1) and error >= 0
        and _semidefinite(numbers[1 + TAIL :], size)
    )  # fmt: skip


def _semidefinite(numbers: np.ndarray, size: int) -> bool:
    matrix = np.zeros((size, size))
    matrix[np.triu_indices(size)] = numbers[: size * (size + 1) // 2]
    scale = np.abs(matrix).max(initial=0.0)
    if scale == 0.0:
        return True
    values = np.linalg.eigvalsh(matrix / scale, UPLO="U")
    return bool(values[0] >= -INDEFINITE * max(values[-1], 0.0))


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Packing:
    """Between mail, leading axis G, and the numbers of messages to G neighbours, padded to the longest.

    Attributes:
        out: (G, W) which number of the mail of a neighbour, all in a row, is the next of its message; padded with how many there are.
        back: (G, F) where in the message each number of its mail is; padded with W.
    """

    out: Array
    back: Array

    @classmethod
    def of(cls, whole: Part, part: Part, width: int) -> Packing:
        """Args: whole: by which messages are laid out; part: among those who are there; width: p of the mail."""
        dimension, known = whole.team.dimension, {neighbour.id: neighbour for neighbour in whole.neighbours}
        letters = [Letter.of(known[neighbour.id], dimension) for neighbour in part.neighbours]
        kept = [Letter.of(neighbour, dimension) for neighbour in part.neighbours]
        count = _Flat(width).total
        longest = max((letter.length for letter in letters), default=0)
        out, back = np.full((len(letters), longest), count), np.full((len(letters), count), longest)
        for row, (letter, there) in enumerate(zip(letters, kept, strict=True)):
            for place, numbers in enumerate(_layout(letter, there, _Flat(width))):
                if numbers:
                    out[row, place] = numbers[0]
                    back[row, numbers] = place
        return cls(jnp.asarray(out.astype(np.int32)), jnp.asarray(back.astype(np.int32)))

    @property
    def longest(self) -> int:
        """W."""
        return self.out.shape[1]

    def pack(self, mail: Mail) -> Array:
        """(G, W) from the mail."""
        count = len(self.out)
        proof = mail.proof
        leaves = (
            mail.changes, mail.barrier, mail.level, mail.margin, proof.weight, proof.constant, proof.error,
            mail.matrix, mail.vector, proof.matrix, proof.vector,
        )  # fmt: skip
        rows = [leaf.reshape(count, math.prod(leaf.shape[1:])) for leaf in leaves]
        flat = jnp.concatenate([*rows, jnp.zeros((count, 1))], axis=1)
        return jnp.take_along_axis(flat, self.out, axis=1)

    def unpack(self, packed: Array, width: int) -> Mail:
        """The mail."""
        count = len(self.back)
        flat = jnp.take_along_axis(jnp.concatenate([packed, jnp.zeros((count, 1))], axis=1), self.back, axis=1)
        cut = _Flat(width)
        numbers = [flat[:, k] for k in range(HEAD + TAIL)]
        changes, barrier, level, margin, weight, constant, error = numbers
        matrix, vector, slope, force = (flat[:, begin:end].reshape(count, *shape) for begin, end, shape in cut.arrays)
        return Mail(matrix, vector, barrier, level, margin, changes, Proof(slope, force, constant, weight, error))


class _Flat(NamedTuple):
    """All numbers of the mail to one neighbour in a row: single ones first, then both quadratics."""

    width: int

    @property
    def arrays(self) -> Iterator[tuple[int, int, tuple[int, ...]]]:
        """Begin, end and shape of each array."""
        at, p = HEAD + TAIL, self.width
        for shape in ((p, p), (p,), (p, p), (p,)):
            size = int(np.prod(shape))
            yield at, at + size, shape
            at += size

    @property
    def total(self) -> int:
        """F."""
        return HEAD + TAIL + 2 * (self.width**2 + self.width)


def _layout(letter: Letter, there: Letter, flat: _Flat) -> Iterator[list[int]]:
    """For each number of a message the numbers of the mail that are equal to it: none where somebody has gone."""
    place = {name: k for k, name in enumerate(there.names)}
    matrix, vector, slope, force = (begin for begin, *_ in flat.arrays)
    yield from ([k] for k in range(3))
    yield [3] if letter.level else []
    for names, square, line, head in (
        (letter.names, matrix, vector, range(0)),
        (letter.names[: letter.size - letter.level], slope, force, range(HEAD, HEAD + TAIL)),
    ):
        yield from ([k] for k in head)
        at = [place.get(name) for name in names]
        for a, left in enumerate(at):
            for right in at[a:]:
                both = left is not None and right is not None
                yield [square + left * flat.width + right, square + right * flat.width + left] if both else []  # type: ignore[operator]
        yield from ([] if k is None else [line + k] for k in at)
