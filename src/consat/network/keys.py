"""Keys."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Credentials:
    """What an agent shows to prove who it is, and by what it tells who others are.

    Attributes:
        ca: certificate of the team's authority.
        certificate: the agent's own, which the authority signed.
        key: its private key.
    """

    ca: Path
    certificate: Path
    key: Path
