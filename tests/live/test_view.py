"""The built view is that of its source, and its own tests pass."""

from __future__ import annotations

import os
import shutil
import subprocess
from pathlib import Path

import pytest

WEB = Path(__file__).parents[2] / "web"
BUILT = Path(__file__).parents[2] / "src" / "consat" / "views"
NODE = shutil.which("node") is not None and (WEB / "node_modules" / "esbuild").is_dir()


@pytest.mark.parametrize("name", ["live.js", "replay.js", "widget.js"])
def test_view_is_small_and_loads_nothing_from_elsewhere(name: str) -> None:
    text = (BUILT / name).read_text(encoding="utf-8")
    assert len(text.encode()) <= 100_000
    for word in ("import(", "eval(", "new Function", "http://", "https://", "innerHTML"):
        assert word not in text, word


@pytest.mark.skipif(
    not NODE and "CONSAT_NODE_REQUIRED" not in os.environ, reason="there is no node with web/node_modules; cd web && npm ci"
)
@pytest.mark.parametrize("script", ["same", "check", "test"])
def test_view_is_that_of_its_source(script: str) -> None:
    done = subprocess.run(["npm", "run", "--silent", script], cwd=WEB, capture_output=True, text=True, check=False, timeout=120)  # noqa: S607
    assert done.returncode == 0, done.stdout + done.stderr
