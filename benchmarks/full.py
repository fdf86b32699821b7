"""The paper's full estimates at the size they allow: a chain of N agents in the plane, each of which estimates all N positions.

    python benchmarks/full.py [--sizes 100 300 1000] [--rounds 10] [--until 0.5]

Seconds a round of admm, seconds a second of the gradient flow, and the peak memory of each; every line in a process of its own.
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import time

PROTOCOLS = ("admm", "gradient-flow")


def chain(count: int) -> object:
    import consat as cs

    agents = [cs.Agent("a0", [cs.within([2, 0], 1)]), *(cs.Agent(f"a{i}", [cs.near(f"a{i - 1}", 1)]) for i in range(1, count))]
    return cs.Team(agents)


def measure(protocol: str, count: int, rounds: int, until: float) -> str:
    import consat as cs

    # the paper's ramp: without it the flow is stiff at once
    smoothing = cs.Smoothing(nu_alpha=5.0, nu_beta=cs.Ramp(start=0.01, to=5.0, rate=0.022))
    how = {"protocol": protocol, "estimates": "full", "start": (-1, 1), "smoothing": smoothing, "agents": "none", "record": False}
    length = {"rounds": rounds} if protocol == "admm" else {"until": until}
    began = time.perf_counter()
    summary = cs.run(chain(count), **how, **length).summary
    whole = time.perf_counter() - began
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    ran = summary["seconds"]["run"]
    each = f"{ran / rounds:.3f} s a round" if protocol == "admm" else f"{ran / until:.1f} s a second"
    return f"| {protocol} | {count} | {2 * count**2:.1e} | {each} | {summary['seconds']['compile']:.1f} | {whole:.1f} | {peak:.2f} | {summary['margin']:.3g} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sizes", type=int, nargs="+", default=[100, 300, 1000])
    parser.add_argument("--rounds", type=int, default=10)
    parser.add_argument("--until", type=float, default=0.5)
    parser.add_argument("--one", nargs=2, help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.one:
        print(measure(asked.one[0], int(asked.one[1]), asked.rounds, asked.until))
        return
    print("| protocol | N | numbers | running | compiling, s | in all, s | peak, GiB | last margin |\n|---|---|---|---|---|---|---|---|")
    for protocol in PROTOCOLS:
        for count in asked.sizes:
            command = [sys.executable, __file__, "--one", protocol, str(count), "--rounds", str(asked.rounds), "--until", str(asked.until)]
            done = subprocess.run(command, capture_output=True, text=True, check=False)
            print(done.stdout.strip() or f"| {protocol} | {count} | failed: {done.stderr.strip().splitlines()[-1]} |", flush=True)


if __name__ == "__main__":
    main()
