"""Run as a program, with every product rounded by itself (see `consat.network.deploy.environment`): lockstep against the engine, to the
last bit.

Prints JSON: the trajectory that `simulate` gives of case C, and for each trial over the network in memory by how much the agents' differ
from what it gives; without trials if an argument says ``truth``.
"""

import json
import sys
import tempfile
from pathlib import Path

import numpy as np

import consat as cs
from consat.faults import Faults
from consat.network.deploy.rehearsal import Rehearsal
from consat.network.node.modes import NodeSettings
from consat.network.node.part import split
from consat.network.transports.memory import MemoryNetwork
from consat.scenario import load
from consat.settings import Sends

ROUNDS = 120
KILLS = ((0.1, "a2"), (0.8, "a1"))
TRIALS = {
    "kills": ("case-c", "interior-point", 0.3, KILLS), "infeasible": ("case-d", "interior-point", 0.3, ()),
    "max-min": ("case-d", "max-min", 0.3, ()), "admm": ("case-c", "admm", 0.3, KILLS),
}  # fmt: skip
"""Scenario, protocol, loss, and who is killed when."""
EVENTS = {
    "events": ("case-c", "interior-point", 0.0, ()), "events, kills": ("case-c", "interior-point", 0.3, KILLS),
    "events, infeasible": ("case-d", "max-min", 0.3, ()), "events, admm": ("case-c", "admm", 0.3, KILLS),
}  # fmt: skip
"""The same where agents send only what is news."""


def trajectories(
    name: str, protocol: str, loss: float, kills: tuple[tuple[float, str], ...], sends: Sends, folder: Path
) -> dict[str, dict[int, list[float]]]:
    """Of all agents by round, over the network in memory; those to be killed start again half a second later."""
    parts = split(load(name, [f"protocol.kind={protocol}"]), run="oracle")
    conditions = Faults(loss=loss, delay=(1e-4, 3e-3), repeat=0.1)
    team = Rehearsal(parts, NodeSettings("lockstep", turns=ROUNDS, report=0.0, sends=sends), MemoryNetwork(conditions))
    for agent in ("a1", "a2", "a3"):  # one after the other, as processes do
        team.start(agent, memory=folder / agent)
        team.run(0.02)
    for when, agent in kills:
        team.run(when - team.network.now)
        team.kill(agent)
        team.run(0.5)
        team.start(agent, memory=folder / agent)
    team.run(60.0)
    tracks: dict[str, dict[int, list[float]]] = {}
    for event in team.events:
        for number, *place in event.get("track", []):
            tracks.setdefault(event["id"], {})[int(number)] = place
    return tracks


def main() -> None:
    truth, ids, found = None, None, {}
    for trial, (name, protocol, loss, kills) in (TRIALS | EVENTS).items():
        sends: Sends = "events" if trial in EVENTS else "all"
        result = cs.run(name, rounds=ROUNDS, protocol=protocol, sends=sends)
        positions, agents = result.data["position"].values, list(result.data["agent"].values)
        if truth is None:
            truth, ids = positions, agents
        if "truth" in sys.argv:
            break
        with tempfile.TemporaryDirectory() as folder:
            tracks = trajectories(name, protocol, loss, kills, sends, Path(folder))
        off = [np.abs(positions[number, agents.index(agent)] - place).max() for agent in agents for number, place in tracks[agent].items()]
        found[trial] = {"rounds": [len(tracks[agent]) for agent in agents], "off": float(max(off))}
    json.dump({"truth": None if truth is None else truth.tolist(), "ids": ids, "found": found}, sys.stdout)


if __name__ == "__main__":
    main()
