"""Case C of the paper, on which the tests of the network run: its optimum has gradients that don't vanish, so nothing is forgiven."""

from dataclasses import replace

import numpy as np

from consat.faults import Faults
from consat.network.deploy.rehearsal import Rehearsal
from consat.network.node.modes import NodeSettings
from consat.network.node.part import Part, split
from consat.network.transports.memory import MemoryNetwork
from consat.scenario import load

GOAL = {"a1": (1.10541, 0.0), "a2": (-0.49880, 0.0), "a3": (-1.10541, 0.0)}
"""Where the smooth margin is largest, to 1e-5 (NETWORK.md, MATH.md; `consat run` agrees)."""

ADMM = ("protocol.kind=admm",)


def parts(*overrides: str, absent: tuple[str, ...] = ()) -> dict[str, Part]:
    return split(load("case-c", overrides), run="rehearsal", absent=absent)


def off(rehearsal: Rehearsal) -> float:
    """How far the team is from its optimum, on the worst axis of the worst agent."""
    positions = rehearsal.positions()
    return max(float(np.abs(positions[agent] - np.array(goal)).max()) for agent, goal in GOAL.items() if agent in positions)


def rehearse(settings: NodeSettings, conditions: Faults | None = None, seed: int = 0, **options: object) -> Rehearsal:
    """All three agents, started; in lockstep they run admm."""
    made = Rehearsal(
        parts(*ADMM if settings.mode == "lockstep" else ()), settings, MemoryNetwork(replace(conditions or Faults(), seed=seed)), **options
    )  # type: ignore[arg-type]
    made.start()
    return made


def events(rehearsal: Rehearsal, kind: str) -> list[dict[str, object]]:
    return [event for event in rehearsal.events if event["event"] == kind]
