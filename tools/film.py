"""The film at the top of README.md: a goal is dragged on the real page until the team's constraints cannot all hold, and back.

    python tools/film.py [docs/figures/live.gif]

Needs Debian's chromium and playwright.
"""

from __future__ import annotations

import io
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from PIL import Image, ImageDraw

import consat as cs

if TYPE_CHECKING:
    from playwright.sync_api import Page

ROOT = Path(__file__).parents[1]
SIZE = {"width": 880, "height": 520}
PACE = 80
"""Milliseconds a picture."""
POINTER = [(0, 0), (0, 17), (4, 13), (7, 20), (10, 19), (7, 12), (13, 12)]


def hand(start: tuple[float, float], goal: tuple[float, float], steps: int) -> Iterator[tuple[float, float]]:
    """Places on the way of a hand, which is slow at both ends."""
    for share in 0.5 - 0.5 * np.cos(np.linspace(0.0, np.pi, steps)):
        yield start[0] + share * (goal[0] - start[0]), start[1] + share * (goal[1] - start[1])


def picture(tab: Page, at: tuple[float, float], *, pressed: bool) -> Image.Image:
    """The page, with the mouse where it is; pictures that a browser takes have none."""
    found = Image.open(io.BytesIO(tab.screenshot())).convert("RGB")
    pen = ImageDraw.Draw(found)
    if pressed:
        pen.ellipse([at[0] - 13, at[1] - 13, at[0] + 13, at[1] + 13], outline="#1c2430", width=2)
    pen.polygon([(at[0] + x, at[1] + y) for x, y in POINTER], fill="#1c2430", outline="white")
    return found


def until(tab: Page, holds: str) -> None:
    """Wait for it."""
    while not tab.evaluate(holds):
        tab.wait_for_timeout(50)


def film(tab: Page) -> Iterator[Image.Image]:
    """The pictures."""
    until(tab, "consat.verdict === 'feasible' && consat.margin > 0.9")
    x, y = tab.evaluate("consat.handle('a1', 'goal')")
    home, near, far = (x, y), (x + 40, y - 60), (x + 135, y - 10)

    def move(path: Iterator[tuple[float, float]], *, pressed: bool) -> Iterator[Image.Image]:
        for at in path:
            tab.mouse.move(*at)
            yield picture(tab, at, pressed=pressed)

    def rest(at: tuple[float, float], holds: str, most: int, *, pressed: bool) -> Iterator[Image.Image]:
        for _ in range(most):
            tab.wait_for_timeout(PACE)
            yield picture(tab, at, pressed=pressed)
            if tab.evaluate(holds):
                break
        until(tab, holds)
        for _ in range(14):
            yield picture(tab, at, pressed=pressed)

    yield from move(hand((x + 110, y + 110), home, 8), pressed=False)
    tab.mouse.down()
    yield from move(hand(home, near, 14), pressed=True)
    yield from move(hand(near, far, 18), pressed=True)
    yield from rest(far, "consat.verdict === 'infeasible' && Math.abs(consat.margin - consat.bounds[1]) < 0.1", 12, pressed=True)
    yield from move(hand(far, home, 20), pressed=True)
    tab.mouse.up()
    yield from rest(home, "consat.verdict === 'feasible' && consat.margin > 0.9", 12, pressed=False)


def save(pictures: list[Image.Image], path: Path) -> None:
    """As a GIF of one palette, so that what stands still costs nothing."""
    tall = np.vstack([np.asarray(each)[::4, ::4] for each in pictures[:: len(pictures) // 12]])
    palette = Image.fromarray(tall).quantize(128, dither=Image.Dither.NONE)
    told = [each.quantize(palette=palette, dither=Image.Dither.NONE) for each in pictures]
    path.parent.mkdir(parents=True, exist_ok=True)
    told[0].save(path, save_all=True, append_images=told[1:], duration=PACE, loop=0, optimize=True, disposal=1)


def main() -> None:
    """Make the film."""
    from playwright.sync_api import sync_playwright

    path = Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "docs" / "figures" / "live.gif"
    options: dict[str, Any] = {"port": 0, "open_page": False, "block": False, "widget": False}
    with cs.live("case-b", seed=1, **options) as live, sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox", "--disable-gpu"])
        tab = browser.new_page(viewport=SIZE, color_scheme="light")
        tab.goto(live.url)
        save(list(film(tab)), path)
        browser.close()


if __name__ == "__main__":
    main()
