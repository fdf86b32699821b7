"""What an agent needs of a network: to send bytes to its neighbours, and to find what they sent. All else may go wrong on the way."""

from __future__ import annotations

from typing import Protocol


class Transport(Protocol):
    """An agent's own end of the links to its neighbours. What is sent may be lost, late, repeated or in disorder."""

    def send(self, neighbour: str, payload: bytes) -> None:
        """Hand over a message and go on; never waits for it to arrive."""
        ...

    def receive(self) -> list[bytes]:
        """All that has arrived since the last call, whoever sent it; never waits. The queue is bounded: the oldest are dropped."""
        ...

    def wait(self, timeout: float) -> bool:
        """Wait until something has arrived, but no longer than `timeout` in s; whether something has."""
        ...

    def alive(self) -> frozenset[str]:
        """The neighbours that are up, as far as the network can tell."""
        ...

    def close(self) -> None:
        """Leave; the neighbours see it."""
        ...
