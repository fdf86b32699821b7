"""Film the live page for the documents: python docs/figures/live.py [CHROMIUM].

It drags a goal of case B, within what the team can do and beyond, and back. The extra test has what it needs.
"""

import io
import sys
import time
from pathlib import Path

from PIL import Image
from playwright.sync_api import Page, sync_playwright

import consat as cs

TARGET = Path(__file__).with_name("live.gif")
SIZE = {"width": 1000, "height": 620}
FRAME = 0.12
"""s between two pictures."""


def dragged(page: Page, agent: str, steps: list[tuple[float, float]]) -> list[bytes]:
    """Pictures while a goal is dragged by steps, in pixels."""
    pictures = []
    x, y = page.evaluate(f"consat.handle('{agent}', 'goal')")
    page.mouse.move(x, y)
    page.mouse.down()
    for dx, dy in steps:
        x, y = x + dx, y + dy
        page.mouse.move(x, y)
        pictures += watched(page, 1)
    page.mouse.up()
    return pictures


def watched(page: Page, count: int) -> list[bytes]:
    """Pictures of what goes on."""
    pictures = []
    for _ in range(count):
        since = time.perf_counter()
        pictures.append(page.screenshot())
        time.sleep(max(FRAME - (time.perf_counter() - since), 0))
    return pictures


live = cs.live("case-b", block=False)
with sync_playwright() as playwright:
    browser = playwright.chromium.launch(executable_path=(sys.argv[1:] or [None])[0], args=["--no-sandbox"])
    page = browser.new_page(viewport=SIZE)
    page.goto(live.url)
    while not page.evaluate("window.consat?.round > 30"):  # its content policy forbids `wait_for_function`
        time.sleep(0.5)
    pictures = watched(page, 6)
    pictures += dragged(page, "a1", [(6, -5)] * 14)  # the team follows
    pictures += watched(page, 8)
    pictures += dragged(page, "a1", [(14, 0)] * 14)  # too far for the tethers
    pictures += watched(page, 14)
    pictures += dragged(page, "a1", [(-20, 5)] * 14)
    pictures += watched(page, 10)
    browser.close()
live.close()
frames = [Image.open(io.BytesIO(each)).convert("RGB").resize((800, 496), Image.Resampling.LANCZOS) for each in pictures]
palette = frames[len(frames) // 2].quantize(128)
frames = [each.quantize(palette=palette, dither=Image.Dither.NONE) for each in frames]
frames[0].save(TARGET, save_all=True, append_images=frames[1:], duration=int(1000 * FRAME), loop=0, optimize=True)
