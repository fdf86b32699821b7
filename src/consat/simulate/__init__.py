"""The whole team in one process: the protocols' per-agent functions over all agents' copies at once."""

from typing import Literal

Stop = Literal["satisfied", "converged", "never"]
"""When to end before the time or the rounds are up."""
