"""Serialisation of `consat.protocols.local.interior.Mail` as the numbers of a message. It contains the variables that the two neighbours
share; of symmetric matrices it contains the upper triangle:

    changes, μ, t, least margin, then upper triangle and vector of the quadratic; Σλ, c, error, then triangle and vector of the proof

The length of a message does not depend on the membership; entries of absent agents are 0.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, field
from typing import Any, Final, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from consat.network.node.core import LARGEST
from consat.network.node.membership import MOST
from consat.network.node.part import Neighbour, Part
from consat.network.wire import Numbers
from consat.numerics import on_device
from consat.protocols.local.interior import Mail, Proof

INDEFINITE: Final = 1e-6
"""A quadratic is refused if its smallest eigenvalue is below −`INDEFINITE` times the largest; rounding errors are smaller."""
HEAD: Final = 4
"""Number of entries before the quadratic: changes, μ, t and the least margin."""
TAIL: Final = 3
"""Number of entries before the quadratic of the proof: Σλ, c and the error."""


class MessageLayout(NamedTuple):
    """Layout of the messages to one neighbour.

    Attributes:
        names: shared variables: (agent, axis) for each coordinate, and last None for the level, if it is shared.
        level: whether the level is shared.
    """

    names: tuple[tuple[str, int] | None, ...]
    level: bool

    @classmethod
    def of(cls, neighbour: Neighbour, dimension: int) -> MessageLayout:
        """Layout for a neighbour. `dimension`: d."""
        places = [(agent, axis) for agent in neighbour.travels for axis in range(dimension)]
        return cls((*places, *[None] * neighbour.level), neighbour.level)

    @property
    def size(self) -> int:
        """p, the number of shared variables."""
        return len(self.names)

    @property
    def length(self) -> int:
        """Number of entries of a message."""
        return HEAD + _both(self.size) + TAIL + _both(self.size - self.level)

    @property
    def weight(self) -> int:
        """Index of Σλ, the first entry of the proof."""
        return HEAD + _both(self.size)

    def numbers(self) -> Numbers:
        """Validity conditions of such a message: shape, largest values, and `sound`."""
        return Numbers((self.length,), tuple(self._largest().tolist()), functools.partial(sound, self.size, self.level))

    def _largest(self) -> np.ndarray:
        largest = np.full(self.length, LARGEST)
        largest[0], largest[3] = MOST, np.inf
        return largest

    def half_numbers(self) -> tuple[Numbers, Numbers]:
        """Validity conditions of the two halves of a message, see `halves`, which are sent with ``sends=events``."""
        short, rest = (tuple(half.tolist()) for half in halves(self._largest(), self.weight))
        return (
            Numbers((len(short),), short, functools.partial(_quadratic_sound, self.size), single=True),
            Numbers((len(rest),), rest, functools.partial(_proof_sound, self.size - self.level)),
        )


def halves(row: np.ndarray, weight: int) -> tuple[np.ndarray, np.ndarray]:
    """The entries of a message that may be rounded to 32 bits (μ, t, least margin, quadratic), and the others (count, proof).

    Args:
        row: the message.
        weight: see `MessageLayout.weight`.
    """
    return row[1:weight], np.concatenate([row[:1], row[weight:]])


def whole(short: np.ndarray, rest: np.ndarray) -> np.ndarray:
    """The message from its two halves."""
    return np.concatenate([rest[:1], short, rest[1:]])


def _both(size: int) -> int:
    """Number of entries of a triangle and a vector of `size` variables."""
    return size * (size + 1) // 2 + size


def sound(size: int, level: bool, numbers: np.ndarray) -> bool:
    """Whether a message can come from a correct agent: both quadratics are positive semidefinite within rounding, the count of changes is a
    whole number from 0, the error is not negative, and weight and barrier are −1 (absent) or not negative.

    Args:
        size: p, the number of shared variables.
        level: whether the level is one of them.
        numbers: the entries of the message.
    """
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
    """Index tables between the mail to G neighbours, flattened to F numbers each, and their messages of up to W numbers.

    Flat mail has first the scalars, then both quadratics.

    Attributes:
        out: (G, W) index in the flat mail of each entry of the message; padded with F.
        back: (G, F) index in the message of each entry of the flat mail; padded with W.
        width: p of the mail.
    """

    out: Array
    back: Array
    width: int = field(metadata={"static": True})

    @classmethod
    def of(cls, whole: Part, part: Part, width: int) -> Packing:
        """Compute the index tables.

        Args:
            whole: the agent's part with all agents, which determines the layout of messages.
            part: the part without absent agents, which determines the mail.
            width: p of the mail.
        """
        dimension, known = whole.team.dimension, {neighbour.id: neighbour for neighbour in whole.neighbours}
        layouts = [MessageLayout.of(known[neighbour.id], dimension) for neighbour in part.neighbours]
        kept = [MessageLayout.of(neighbour, dimension) for neighbour in part.neighbours]
        total, longest = HEAD + TAIL + 2 * (width**2 + width), max((layout.length for layout in layouts), default=0)
        out, back = np.full((len(layouts), longest), total), np.full((len(layouts), total + 1), longest)
        upper = np.triu_indices(width)
        for row, (layout, there) in enumerate(zip(layouts, kept, strict=True)):
            entries = _entries(layout, there, np.arange(total), width)
            out[row, : len(entries)] = entries
            back[row, entries] = np.arange(len(entries))
            for matrix, _ in _quadratics(np.arange(total), width):
                back[row, matrix.T[upper]] = back[row, matrix[upper]]
        return cls(on_device(out.astype(np.int32)), on_device(back[:, :total].astype(np.int32)), width)

    def pack(self, mail: Mail) -> Array:
        """(G, W) the messages for a mail."""
        count, proof = len(self.out), mail.proof
        leaves = (
            mail.changes, mail.barrier, mail.level, mail.margin, proof.weight, proof.constant, proof.error,
            mail.matrix, mail.vector, proof.matrix, proof.vector,
        )  # fmt: skip
        rows = [leaf.reshape(count, math.prod(leaf.shape[1:])) for leaf in leaves]
        flat = jnp.concatenate([*rows, jnp.zeros((count, 1))], axis=1)
        return jnp.take_along_axis(flat, self.out, axis=1)

    def unpack(self, packed: Array) -> Mail:
        """The mail of messages, (G, W)."""
        flat = jnp.take_along_axis(jnp.concatenate([packed, jnp.zeros((len(self.back), 1))], axis=1), self.back, axis=1)
        changes, barrier, level, margin, weight, constant, error = flat[:, : HEAD + TAIL].T
        (matrix, vector), (slope, force) = _quadratics(flat, self.width)
        return Mail(matrix, vector, barrier, level, margin, changes, Proof(slope, force, constant, weight, error))


def _quadratics(flat: Any, p: int) -> tuple[tuple[Any, Any], tuple[Any, Any]]:
    """Matrix, (…, p, p), and vector, (…, p), of the quadratic and of that of the proof in flat mail, (…, F)."""
    begin, size = HEAD + TAIL, p**2 + p
    one, other = (
        (part[..., : p**2].reshape(*part.shape[:-1], p, p), part[..., p**2 :])
        for part in (flat[..., begin : begin + size], flat[..., begin + size :])
    )
    return one, other


def _entries(layout: MessageLayout, there: MessageLayout, flat: np.ndarray, p: int) -> np.ndarray:
    """Index in the flat mail of each entry of a message; F for absent agents.

    Args:
        layout: layout of the message, with all agents.
        there: layout of the mail, without absent agents.
        flat: (F,) the indices of flat mail.
        p: width of the mail.
    """
    absent, place = len(flat), {name: k for k, name in enumerate(there.names)}
    heads = [0, 1, 2, 3 if layout.level else absent], range(HEAD, HEAD + TAIL)
    names = layout.names, layout.names[: layout.size - layout.level]
    entries: list[Any] = []
    for head, shared, quadratic in zip(heads, names, _quadratics(flat, p), strict=True):
        matrix, vector = (np.pad(indices, (0, 1), constant_values=absent) for indices in quadratic)
        at = np.array([place.get(name, p) for name in shared], dtype=int)
        rows, columns = np.triu_indices(len(at))
        entries += [head, matrix[at[rows], at[columns]], vector[at]]
    return np.concatenate(entries)
