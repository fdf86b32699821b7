"""The page that replays a run, in a real browser: its script runs under its own policy, draws, and tells what it shows."""

from __future__ import annotations

import html
import re
import subprocess
from pathlib import Path

import pytest

import consat as cs
from tests.browser import BROWSER, needs_browser
from tests.unit.test_views import made

pytestmark = needs_browser


def opened(page: Path, tmp_path: Path, size: str = "1280,800") -> str:
    """The document as it is some seconds after it was opened, from disk, without a network, by a reader who wants little motion."""
    words = [
        str(BROWSER), "--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--force-prefers-reduced-motion",
        "--proxy-server=127.0.0.1:9", f"--user-data-dir={tmp_path / 'profile'}", f"--window-size={size}", "--virtual-time-budget=3000",
        "--enable-logging=stderr", "--dump-dom", page.resolve().as_uri(),
    ]  # fmt: skip
    done = subprocess.run(words, capture_output=True, text=True, check=True, timeout=120)
    console = [line for line in done.stderr.splitlines() if "CONSOLE" in line]
    assert not console, console  # violations of the policy and errors of the script
    return done.stdout


@pytest.mark.parametrize("kind", ["few", "crowd", "space"])
def test_page_runs_from_disk_and_tells_what_it_shows(kind: str, tmp_path: Path) -> None:
    if kind == "few":
        result = cs.run("case-b", rounds=30)
    elif kind == "crowd":
        agents = [cs.Agent(f"q{i}", [cs.within([i, 0], 1), cs.outside([20, 5], 1)]) for i in range(40)]
        import numpy as np

        result = made(cs.Team(agents, links="line"), np.stack([np.arange(40.0), np.zeros(40)], axis=1), samples=10, clock="round")
    else:
        import numpy as np

        agents = [cs.Agent("a", [cs.within([0, 1, 2], 1), *cs.box([-3, -3, -1], [3, 3, 4])]), cs.Agent("b", [cs.near("a", 1)])]
        result = made(cs.Team(agents, dimension=3), np.array([[0.0, 1.0, 2.0], [0.5, 1.0, 2.0]]), samples=10, clock="round")
    text = opened(result.html(tmp_path / "run.html"), tmp_path)
    last = int(result.data["round"][-1])
    [label] = re.findall(r'<canvas data-part="stage"[^>]*aria-label="([^"]*)"', text)
    assert f"{len(result.data['agent'])} agents, round {last}, margin " in html.unescape(label)
    assert re.search(rf'<output data-part="step">round {last}</output>', text)
    assert len(re.findall(r"<button[^>]*data-agent=", text)) == min(12, len(result.data["agent"]))
    width = int(re.findall(r'<canvas data-part="stage"[^>]*width="(\d+)"', text)[0])
    assert width > 500  # it was laid out, so it was drawn


def test_every_control_has_a_name(tmp_path: Path) -> None:
    text = opened(cs.run("case-b", rounds=5).html(tmp_path / "run.html"), tmp_path, "390,844")
    for tag, inside in re.findall(r"<((?:button|input|select|canvas)\b[^>]*)>([^<]*)", text):
        assert "aria-label=" in tag or inside.strip() or "checkbox" in tag or "data-agent" in tag, tag
    assert len(re.findall(r'<label><input type="checkbox"[^>]*> \w+</label>', text)) == 4
