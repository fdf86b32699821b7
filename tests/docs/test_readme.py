"""Everything that the documents tell a reader to type works: the two marked commands, the Python examples, the scenarios."""

import re
import shlex
import subprocess
import sys
import sysconfig
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).parents[2]
SCRIPTS = Path(sysconfig.get_path("scripts"))
DOCUMENTS = [ROOT / "README.md", *sorted((ROOT / "docs").glob("**/*.md"))]


class Block(NamedTuple):
    """A fenced block of a document."""

    language: str
    text: str
    line: int
    marker: str | None


def blocks(document: Path) -> Iterator[Block]:
    """The fenced blocks of a document; `marker` is the word of an HTML comment on the line right above, as in ``<!-- test -->``."""
    text = document.read_text()
    for match in re.finditer(r"(?:^<!-- (\w+) -->\n+)?^```(\w*)\n(.*?)^```$", text, flags=re.MULTILINE | re.DOTALL):
        yield Block(match[2], match[3], text.count("\n", 0, match.start(3)) + 1, match[1])


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


@pytest.mark.parametrize("document", DOCUMENTS, ids=named)
def test_python_examples_run(document: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One after the other in one namespace, as a reader would paste them."""
    monkeypatch.chdir(tmp_path)
    namespace: dict[str, object] = {"__name__": "__main__"}
    for block in blocks(document):
        if block.language == "python":
            source = "\n" * (block.line - 1) + block.text  # a traceback shows the line of the document
            exec(compile(source, document, "exec"), namespace)  # noqa: S102


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
