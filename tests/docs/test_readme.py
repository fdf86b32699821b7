"""Everything that the documents tell a reader to type works: the two marked commands, the examples, the scenarios."""

import os
import re
import shlex
import subprocess
import sys
import sysconfig
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

from consat.cli import main

ROOT = Path(__file__).parents[2]
SCRIPTS = Path(sysconfig.get_path("scripts"))
DOCUMENTS = [ROOT / "README.md", *sorted((ROOT / "docs").glob("**/*.md"))]


SMALLER = {
    "count=1000000": "count=1000",
    "count: 10000": "count: 400",
    "10_000": "1_000",
    "seeds=100": "seeds=20",
    "--until 20": "--until 2",
}
"""Pages are built with a million agents; here a thousand do."""


class Block(NamedTuple):
    """A fenced block of a document; `options` follow the language, as in ``console exec="on"``."""

    language: str
    options: dict[str, str]
    text: str
    line: int
    marker: str | None


def blocks(document: Path) -> Iterator[Block]:
    """The fenced blocks of a document; `marker` is the word of an HTML comment on the line right above, as in ``<!-- test -->``."""
    text = document.read_text()
    for match in re.finditer(r"(?:^<!-- (\w+) -->\n+)?^```(\w*)( [^\n]*)?\n(.*?)^```$", text, flags=re.MULTILINE | re.DOTALL):
        options = dict(re.findall(r'(\w+)="(.*?)"', match[3] or ""))
        source = re.sub("|".join(SMALLER), lambda size: SMALLER[size[0]], match[4])
        yield Block(match[2], options, source, text.count("\n", 0, match.start(4)) + 1, match[1])


def named(document: Path) -> str:
    return str(document.relative_to(ROOT))


def command(marker: str) -> str:
    """The command of the README's block with this marker."""
    [block] = [block for block in blocks(ROOT / "README.md") if block.marker == marker]
    return block.text.strip()


@pytest.mark.parametrize("marker", ["run", "test"])
def test_marked_command_installs_what_is_locked_in_a_fresh_environment(marker: str) -> None:
    make, install, _ = command(marker).split(" && ")
    assert make == "python3 -m venv .venv"
    assert install.startswith(".venv/bin/pip install ")
    assert "-c requirements.lock" in install


def test_run_command_runs(tmp_path: Path) -> None:
    program, *arguments = shlex.split(command("run").split(" && ")[-1])
    assert program == ".venv/bin/consat"
    done = subprocess.run([SCRIPTS / "consat", *arguments], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert any(tmp_path.rglob("*.*")), "the README's run wrote no file"


def test_test_command_runs_every_test() -> None:
    assert command("test").split(" && ")[-1] == ".venv/bin/pytest"


def typed(line: str, monkeypatch: pytest.MonkeyPatch) -> int:
    """The exit code of what stands after a prompt; ours run in this process, which has compiled already."""
    words = shlex.split(line)
    if words[0] != "consat":
        return subprocess.run(words, check=False).returncode
    with monkeypatch.context() as patch:
        patch.setattr(sys, "argv", words)
        patch.setattr(os, "environ", dict(os.environ))
        with pytest.raises(SystemExit) as left:
            main()
    return int(left.value.code or 0)


@pytest.mark.parametrize("document", DOCUMENTS, ids=named)
def test_examples_of_a_document_run(document: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One after the other, as a reader would type them; Python in a namespace for each session."""
    monkeypatch.chdir(tmp_path)
    sessions: defaultdict[str, dict[str, object]] = defaultdict(lambda: {"__name__": "__main__"})
    for block in blocks(document):
        if name := block.options.get("title"):
            Path(name).write_text(block.text, encoding="utf-8")
        if block.language == "python":
            source = "\n" * (block.line - 1) + block.text  # a traceback shows the line of the document
            exec(compile(source, document, "exec"), sessions[block.options.get("session", "")])  # noqa: S102
        if block.language == "console" and "exec" in block.options:
            for line in re.findall(r"^\$ (.*)", block.text, flags=re.MULTILINE):
                code = typed(line, monkeypatch)
                assert code == int(block.options.get("returncode", "0")), f"{named(document)}, line {block.line}: {line} exits with {code}"


@pytest.mark.parametrize("document", DOCUMENTS, ids=named)
def test_scenarios_are_valid(document: Path, tmp_path: Path) -> None:
    for block in blocks(document):
        if block.language == "yaml" and block.text.startswith("consat:"):
            file = tmp_path / f"line-{block.line}.yaml"
            file.write_text(block.text)
            done = subprocess.run([SCRIPTS / "consat", "check", file], capture_output=True, text=True, check=False)
            assert done.returncode == 0, f"{named(document)}, line {block.line}: {done.stderr}"


@pytest.mark.parametrize("example", sorted((ROOT / "examples").glob("*.py")), ids=named)
def test_examples_run(example: Path, tmp_path: Path) -> None:
    done = subprocess.run([sys.executable, example], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
