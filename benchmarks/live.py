"""The live page: frames a second and drag to reply in headless, software-rendered Chromium, and a fuzz of client messages.

    python benchmarks/live.py [--agents 10,100,1000,10000] [--fuzz 1000000] [--out docs/benchmarks/live.md]

A lattice team with links; every third agent has a goal. Frames are those that the page draws while the session runs; a reply is the time
from the order of a dragged goal to its answer, as the page measures it; it is dragged once the team is assessed.
"""

from __future__ import annotations

import argparse
import random
import shutil
import sys
import time
from pathlib import Path

import numpy as np

import consat as cs

sys.path.insert(0, str(Path(__file__).parents[1]))


def lattice(count: int) -> cs.Team:
    rng, side = np.random.default_rng(0), int(np.ceil(np.sqrt(count)))
    agents, links = [], []
    for i in range(count):
        x, y = 2 * (i % side), 2 * (i // side)
        constraints = [cs.within([x + rng.uniform(-0.3, 0.3), y + rng.uniform(-0.3, 0.3)], 1.0, name="goal")] if i % 3 == 0 else []
        for j in ([i - 1] if i % side else []) + ([i - side] if i >= side and i % 2 == 0 else []):
            constraints.append(cs.near(f"q{j}", 2.6))
            links.append((f"q{i}", f"q{j}"))
        agents.append(cs.Agent(f"q{i}", constraints, [x + rng.normal(), y + rng.normal()]))
    return cs.Team(agents, links)


def measure(count: int, seconds: float = 8.0) -> dict[str, float]:
    from playwright.sync_api import sync_playwright

    begun = time.perf_counter()
    with cs.live(lattice(count), port=0, open_page=False, block=False) as live, sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox", "--disable-gpu"])
        tab = browser.new_page(viewport={"width": 1280, "height": 800})
        tab.goto(live.url)
        while tab.evaluate("consat.round") < 10:  # the page's own policy forbids what evaluates text in it
            tab.wait_for_timeout(100)
        built = time.perf_counter() - begun
        while not tab.evaluate("consat.reasons.length"):  # until the team as it began is assessed, which happens once and beside
            tab.wait_for_timeout(100)
        first = tab.evaluate("consat.round")
        drawn = tab.evaluate("consat.drawn")
        tab.wait_for_timeout(1000 * seconds)
        frames = (tab.evaluate("consat.drawn") - drawn) / seconds
        rounds = (tab.evaluate("consat.round") - first) / seconds
        goal = f"q{3 * (count // 6)}"
        x, y = tab.evaluate(f"consat.handle('{goal}', 'goal')")
        replies = []
        tab.mouse.move(x, y)
        tab.mouse.down()
        for k in range(100):
            tab.mouse.move(x + k / 5, y + k / 10)
            tab.wait_for_timeout(20)
            replies.append(tab.evaluate("consat.latency"))
        tab.mouse.up()
        browser.close()
    told = np.array([each for each in replies if each is not None and np.isfinite(each)])
    median, late = np.percentile(told, [50, 95]) if len(told) else (np.nan, np.nan)
    return {"agents": count, "frames": frames, "rounds": rounds, "median": median, "late": late, "built": built}


def fuzz(count: int) -> str:
    from consat.errors import InvalidSettings
    from consat.server import orders
    from tests.live.test_orders import garbled

    random_, read, begun = random.Random(18), 0, time.perf_counter()  # noqa: S311
    for _ in range(count):
        try:
            orders.parse(garbled(random_))
            read += 1
        except InvalidSettings:
            pass
    return f"{count:,} messages: {read:,} orders, {count - read:,} refused in words, nothing else; {time.perf_counter() - begun:.0f} s"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--agents", default="10,100,1000,10000")
    parser.add_argument("--fuzz", type=int, default=0)
    parser.add_argument("--out", type=Path)
    arguments = parser.parse_args()
    lines = [
        "| agents | frames/s drawn | rounds/s | reply to a drag, median | 95th percentile | until it runs |",
        "|---:|---:|---:|---:|---:|---:|",
    ]
    print("\n".join(lines))
    for count in map(int, filter(None, arguments.agents.split(","))):
        found = measure(count)
        lines.append("| {agents:,} | {frames:.0f} | {rounds:.0f} | {median:.0f} ms | {late:.0f} ms | {built:.0f} s |".format(**found))
        print(lines[-1], flush=True)
    said = fuzz(arguments.fuzz) if arguments.fuzz else ""
    print(said)
    if arguments.out:
        arguments.out.write_text("\n".join(["# Live page", "", *lines, "", said, ""]), encoding="utf-8")


if __name__ == "__main__":
    main()
