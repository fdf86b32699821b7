"""A type checker that is strict shows users their mistakes, and nothing where there are none."""

import json
import re
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SCRIPTS = Path(sysconfig.get_path("scripts"))
SCRIPT = Path(__file__).with_name("mistakes.txt")


def mistakes(text: str) -> dict[int, str]:
    """Of each line with a mistake the rule that it breaks, as mypy calls it."""
    lines = enumerate(text.splitlines(), 1)
    return {number: found[1] for number, line in lines if (found := re.search(r"# E: ([\w-]+)$", line))}


def test_mypy_finds_each_mistake_of_a_user_and_no_other(tmp_path: Path) -> None:
    text = SCRIPT.read_text(encoding="utf-8")
    script = tmp_path / "script.py"
    script.write_text(text, encoding="utf-8")
    # Strict, as the project's own settings are; so its cache serves here, too.
    words = [SCRIPTS / "mypy", "--config-file", ROOT / "pyproject.toml", "--follow-imports", "silent", "--no-pretty", script]
    done = subprocess.run(words, cwd=ROOT, env={"MYPYPATH": str(ROOT / "src")}, capture_output=True, text=True, check=False)
    wanted = mistakes(text)
    told = dict(re.findall(r"script\.py:(\d+): error: .*\[([\w-]+)\]", done.stdout))
    assert {int(line): rule for line, rule in told.items()} == wanted, done.stdout + done.stderr


@pytest.mark.skipif(not (SCRIPTS / "pyright").exists(), reason="pyright is not installed (pip install pyright; it fetches itself with npm)")
def test_pyright_finds_each_mistake_of_a_user_and_no_other(tmp_path: Path) -> None:
    text = SCRIPT.read_text(encoding="utf-8")
    (tmp_path / "script.py").write_text(text, encoding="utf-8")
    settings = {"typeCheckingMode": "standard", "extraPaths": [str(ROOT / "src")], "reportUnnecessaryComparison": "error"}
    (tmp_path / "pyrightconfig.json").write_text(json.dumps(settings))
    words = [SCRIPTS / "pyright", "--outputjson", "--pythonpath", sys.executable, "script.py"]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=False)
    told = json.loads(done.stdout[done.stdout.index("{") :])["generalDiagnostics"]
    found = {each["range"]["start"]["line"] + 1 for each in told if each["severity"] == "error"}
    assert found == set(mistakes(text)), told
