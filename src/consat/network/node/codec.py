"""Between the rows of a core and the arrays of the messages to each neighbour.

A message of state has two arrays. The first, (shares, width + 1), has the core's row of each position that both ends share, 0 for absent
agents, and in the last column the membership number of each agent. The second is the core's row for this neighbour, 0 if it is absent;
with ``sends=events`` in mode interior-point it is split in two, see `consat.network.node.pairs.halves`. In lockstep a message has the
arrays of two rounds, and the number of the newer one.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from consat.network.node.core import LARGEST, Rows
from consat.network.node.embodied import Embodied
from consat.network.node.membership import Membership
from consat.network.node.modes import NodeSettings
from consat.network.node.pair_core import PairCore
from consat.network.node.pairs import MessageLayout, halves, whole
from consat.network.node.part import Neighbour, Part
from consat.network.wire import Expected, Kind, Numbers


class Codec:
    """See the module.

    Args:
        part: the agent's part, with all agents.
        core: its core, for the agents that are present.
        membership: which agents are present.
        settings: mode, and what is sent.
    """

    def __init__(self, part: Part, core: Embodied, membership: Membership, settings: NodeSettings) -> None:
        self._core, self._membership, self._settings = core, membership, settings
        self._shares = {neighbour.id: neighbour.shares for neighbour in part.neighbours}
        end = {end: k for k, end in enumerate(core.ends)}
        self._places = {  # for each neighbour the ends of links at the shared positions; −1 where the agent is absent
            neighbour: np.array([end.get((neighbour, agent), -1) for agent in shares]) for neighbour, shares in self._shares.items()
        }
        self._row = {neighbour.id: k for k, neighbour in enumerate(core.part.neighbours)}
        halved = settings.sends == "events" and isinstance(core.core, PairCore)
        self._layouts = {neighbour.id: MessageLayout.of(neighbour, part.team.dimension) for neighbour in part.neighbours if halved}

    def expected(self, neighbour: Neighbour) -> Expected:
        """Expected arrays of a neighbour's messages."""
        shares, largest, lockstep = len(neighbour.shares), self._core.largest, self._settings.mode == "lockstep"
        layout = self._layouts.get(neighbour.id)
        pair = (self._core.pair_numbers[neighbour.id],) if layout is None else layout.half_numbers()
        frame = [Numbers((shares, len(largest) + 1), (*largest.tolist(), LARGEST)), *pair]
        state = [*frame, *frame, Numbers((1,))] if lockstep else frame
        found: dict[Kind, Sequence[Numbers | tuple[int, ...]]] = {Kind.HELLO: [(shares,)], Kind.STATE: state, Kind.GOODBYE: []}
        return found | ({Kind.SAME: [(1,)]} if lockstep and self._settings.sends == "events" else {})

    def encode(self, outbox: Rows) -> dict[str, list[np.ndarray]]:
        """The arrays to send to each neighbour. `outbox`: messages of the core."""
        arrays = {}
        for neighbour, place in self._places.items():
            block = np.zeros((len(place), self._core.width + 1))
            block[place >= 0, :-1] = outbox.link[place[place >= 0]]
            block[:, -1] = self._membership.of(self._shares[neighbour])
            message, row = np.zeros(self._core.pair_numbers[neighbour].shape), self._row.get(neighbour)
            if row is not None:
                message = outbox.pair[row, : len(message)]
            layout = self._layouts.get(neighbour)
            arrays[neighbour] = [block, *([message] if layout is None else halves(message, layout.weight))]
        return arrays

    def single(self, arrays: Sequence[np.ndarray]) -> range:
        """Which of the arrays of a message are written in 32 bits: the first half of each row for a neighbour."""
        return range(1, len(arrays) if self._layouts else 1, 3)

    def decode(self, neighbour: str, arrays: Sequence[np.ndarray], inbox: Rows, arrived: Rows) -> None:
        """Write a message into the inbox. Rows of links are used where both ends agree on the membership of the shared agent; the row of
        the neighbour is used where they agree on all shared agents.

        Args:
            neighbour: id of the sender.
            arrays: the arrays of the message.
            inbox: rows of the messages; modified.
            arrived: masks of arrival; modified.
        """
        block, *pair = arrays
        message = pair[0] if len(pair) == 1 else whole(*pair)
        place, row = self._places[neighbour], self._row.get(neighbour)
        same = block[:, -1] == self._membership.of(self._shares[neighbour])
        agrees = (place >= 0) & same
        inbox.link[place[agrees]] = block[agrees, :-1]
        arrived.link[place[agrees]] = True
        if row is not None and same.all():
            inbox.pair[row, : len(message)] = message
            arrived.pair[row] = True

    def unchanged(self, arrays: Sequence[np.ndarray]) -> list[np.ndarray]:
        """The message that a neighbour without news would have sent. `arrays`: the arrays of its previous message."""
        block = arrays[0].copy()
        for column in self._core.ages:
            block[:, column] += block[:, column] > 0
        return [block, *arrays[1:]]
