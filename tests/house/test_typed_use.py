"""A type checker that is strict shows users their mistakes, and nothing where there are none."""

import re
import subprocess
import sysconfig
from pathlib import Path

ROOT = Path(__file__).parents[2]
SCRIPTS = Path(sysconfig.get_path("scripts"))
SCRIPT = Path(__file__).with_name("mistakes.txt")


def test_mypy_finds_each_mistake_of_a_user_and_no_other(tmp_path: Path) -> None:
    text = SCRIPT.read_text(encoding="utf-8")
    script = tmp_path / "script.py"
    script.write_text(text, encoding="utf-8")
    # Strict, as the project's own settings are; so its cache serves here, too.
    words = [SCRIPTS / "mypy", "--config-file", ROOT / "pyproject.toml", "--follow-imports", "silent", "--no-pretty", script]
    done = subprocess.run(words, cwd=ROOT, env={"MYPYPATH": str(ROOT / "src")}, capture_output=True, text=True, check=False)
    wanted = {number: found[1] for number, line in enumerate(text.splitlines(), 1) if (found := re.search(r"# E: ([\w-]+)$", line))}
    told = dict(re.findall(r"script\.py:(\d+): error: .*\[([\w-]+)\]", done.stdout))
    assert {int(line): rule for line, rule in told.items()} == wanted, done.stdout + done.stderr
