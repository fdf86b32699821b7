"""Agents as processes on this machine: rounds a second in lockstep, latency, CPU, and how soon a crash is noticed and mended.

    python benchmarks/network.py [--agents 3,10,20] [--seconds 10]

Prints a table. Everything runs on 127.0.0.1; the figures are of this machine and of what else runs on it.
"""

from __future__ import annotations

import argparse
import os
import time
import uuid
from pathlib import Path

import numpy as np

from consat.network.deploy.fleet import Event, Fleet, free_ports
from consat.network.node.part import split
from consat.scenario import Scenario, load, loads

START = 300.0
GOAL = {"a1": (1.10541, 0.0), "a2": (-0.49880, 0.0), "a3": (-1.10541, 0.0)}
TICK = os.sysconf("SC_CLK_TCK")


def chain(count: int) -> Scenario:
    """A leader with a goal, and followers, each near the one ahead; everybody talks to two neighbours."""
    agents = ["  - {id: a1, constraints: [{kind: within, center: [2, 0], radius: 1}]}"]
    agents += [f"  - {{id: a{i}, constraints: [{{kind: near, agent: a{i - 1}, radius: 1}}]}}" for i in range(2, count + 1)]
    return loads("\n".join(["consat: 1", "agents:", *agents, "communication: {graph: line}", "start: {box: [-4, 4]}"]), f"chain-{count}")


def fleet(scenario: Scenario, options: list[str]) -> Fleet:
    ids = scenario.team.ids
    addresses = {agent: f"tcp/127.0.0.1:{port}" for agent, port in zip(ids, free_ports(len(ids)), strict=True)}
    return Fleet(split(scenario, run=f"bench-{uuid.uuid4().hex[:8]}", addresses=addresses), options)


def cpu(pid: int) -> float:
    """Seconds that a process has computed."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / TICK


class Ears:
    """The last report of each agent, and how often each has taken a turn."""

    def __init__(self) -> None:
        self.reports: dict[str, Event] = {}
        self.turns: dict[str, float] = {}
        self.events: list[Event] = []

    def listen(self, fleet: Fleet, seconds: float) -> None:
        for event in fleet.poll(seconds):
            if event["event"] == "report":
                self.reports[event["id"]] = event
                self.turns[event["id"]] = self.turns.get(event["id"], 0) + len(event["track"])
            else:
                self.events.append(event)


def rounds(count: int, seconds: float) -> dict[str, float]:
    """Lockstep as fast as it goes."""
    scenario, ears, began = chain(count), Ears(), time.monotonic()
    with fleet(scenario, ["--mode", "lockstep", "--report", "0.5"]) as team:
        for agent in scenario.team.ids:
            team.start(agent)
        while min((ears.turns.get(agent, 0) for agent in scenario.team.ids), default=0) < 20:
            ears.listen(team, 0.1)
            if time.monotonic() - began > START:
                raise SystemExit(f"{count} agents did not start within {START:.0f} s")
        up = time.monotonic()
        before, turns = {agent: cpu(team.pid(agent)) for agent in scenario.team.ids}, dict(ears.turns)
        while time.monotonic() - up < seconds:
            ears.listen(team, 0.1)
        elapsed = time.monotonic() - up
        done = np.mean([ears.turns[agent] - turns[agent] for agent in scenario.team.ids])
        used = np.mean([cpu(team.pid(agent)) - before[agent] for agent in scenario.team.ids])
        trips = [peer["trip"] for report in ears.reports.values() for peer in report["peers"].values() if peer["trip"] is not None]
        team.stop()
    return {
        "start": up - began, "rate": float(done / elapsed), "cpu": float(used / elapsed), "per_round": float(used / max(done, 1)),
        "latency": float(np.median(trips)) / 2,
    }  # fmt: skip


def off(ears: Ears) -> float:
    return max(float(np.abs(np.subtract(ears.reports[a]["position"], GOAL[a])).max()) if a in ears.reports else np.inf for a in GOAL)


def crash() -> dict[str, float]:
    """Case C, admm: SIGKILL of the agent in the middle, a restart without memory."""
    ears = Ears()
    with fleet(load("case-c"), ["--mode", "admm", "--report", "0.02"]) as team:
        for agent in GOAL:
            team.start(agent)
        end = time.monotonic() + START
        while off(ears) > 1e-3 and time.monotonic() < end:
            ears.listen(team, 0.02)
        pid, spent, at = team.pid("a1"), cpu(team.pid("a1")), time.monotonic()
        while time.monotonic() < at + 5.0:
            ears.listen(team, 0.1)
        share = (cpu(pid) - spent) / (time.monotonic() - at)
        ears.events.clear()
        killed = time.monotonic()
        team.kill("a2")
        while len({e["id"] for e in ears.events if e["event"] == "down"}) < 2 and time.monotonic() < end:
            ears.listen(team, 0.01)
        noticed = max(event["t"] for event in ears.events if event["event"] == "down") - killed
        restarted = time.monotonic()
        del ears.reports["a2"]
        ears.events.clear()
        team.start("a2", "--position", "3,3")
        while not any(event["event"] == "start" and event["id"] == "a2" for event in ears.events):
            ears.listen(team, 0.01)
        ready = time.monotonic()
        while off(ears) > 1e-3 and time.monotonic() < end:
            ears.listen(team, 0.01)
        back = time.monotonic()
        team.stop()
    return {"noticed": noticed, "restart": ready - restarted, "back": back - ready, "share": share}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--agents", default="3,10,20")
    parser.add_argument("--seconds", type=float, default=10.0)
    asked = parser.parse_args()
    print(f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}\n")
    print("| lockstep, agents | start, s | rounds/s | latency one way, ms | CPU of an agent, cores | CPU of a round, ms |")
    print("|---|---|---|---|---|---|")
    for count in map(int, asked.agents.split(",")):
        r = rounds(count, asked.seconds)
        cells = f"{r['rate']:.0f} | {1e3 * r['latency']:.2f} | {r['cpu']:.2f} | {1e3 * r['per_round']:.2f}"
        print(f"| {count} | {r['start']:.1f} | {cells} |", flush=True)
    c = crash()
    print("\n| admm, case C, 100 Hz | |")
    print("|---|---|")
    print(f"| CPU of an agent, cores | {c['share']:.2f} |")
    print(f"| SIGKILL noticed by both neighbours after | {1e3 * c['noticed']:.0f} ms |")
    print(f"| restarted agent ready (Python, JAX, compilation cache) after | {c['restart']:.1f} s |")
    print(f"| and the team back within 1e-3 of the optimum after | {c['back']:.2f} s more |")


if __name__ == "__main__":
    main()
