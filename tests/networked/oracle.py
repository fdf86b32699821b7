"""Run as a program, with every product rounded by itself (see `consat.network.environment`): lockstep against `simulate`, to the last bit.

Prints JSON: the trajectory that `simulate` gives, and for each trial over the network in memory by how much the agents' differ from it;
without trials if an argument says ``truth``.
"""

import json
import sys
import tempfile
from pathlib import Path

import numpy as np

import consat as cs
from consat.network.modes import Manner
from consat.network.transports.memory import Conditions
from tests.networked.case_c import rehearse

ROUNDS = 120


def trajectories(loss: float, kills: tuple[tuple[float, str], ...], folder: Path) -> dict[str, dict[int, list[float]]]:
    """Of all agents by round, over the network in memory; those to be killed start again half a second later."""
    manner = Manner("lockstep", turns=ROUNDS, report=0.0)
    team = rehearse(manner, Conditions(loss=loss, delay=(1e-4, 3e-3), repeat=0.1))
    team.kill("a1", "a2", "a3")
    for agent in ("a1", "a2", "a3"):  # one after the other, as processes do
        team.start(agent, memory=folder / agent)
        team.run(0.02)
    for when, agent in kills:
        team.run(when - team.air.now)
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
    result = cs.run("case-c", rounds=ROUNDS)
    truth = result.data["position"].values
    ids = list(result.data["agent"].values)
    found = {}
    trials = ("perfect", 0.0, ()), ("loss", 0.3, ()), ("kills", 0.3, ((0.1, "a2"), (0.8, "a1")))
    for name, loss, kills in () if "truth" in sys.argv else trials:
        with tempfile.TemporaryDirectory() as folder:
            tracks = trajectories(loss, kills, Path(folder))
        differences = [np.abs(truth[number, ids.index(agent)] - place).max() for agent in ids for number, place in tracks[agent].items()]
        found[name] = {"rounds": [len(tracks[agent]) for agent in ids], "off": float(max(differences))}
    json.dump({"truth": truth.tolist(), "ids": ids, "found": found}, sys.stdout)


if __name__ == "__main__":
    main()
