"""Each worked diff of CONTRIBUTING.md, applied to a copy of the source, does what it says."""

import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
SECTIONS = dict(re.findall(r"^### (.+?)\n(.*?)(?=^### |\Z)", TEXT, flags=re.MULTILINE | re.DOTALL))
USES = {
    "A kind of constraint": """
scenario = '''
consat: 1
agents:
  - {id: a, start: [5, 5], constraints: [{kind: ellipse, center: [1, 0], axes: [2, 0.5], name: zone}]}
'''
r = cs.run(cs.loads(scenario))
assert r.summary["status"] == "satisfied" and r.summary["margin"] > 0.2, r.summary
from consat.certify.quadratics import shape_of
assert shape_of(cs.loads(scenario).team).concave.all()
try: cs.loads(scenario.replace("[2, 0.5]", "[2]"))
except cs.InvalidScenario as error: assert "axes has 1 entry" in str(error)
session = cs.Session(cs.loads(scenario)).step(20)
try: session.change("a", "zone", axes=[0, 0])
except cs.InvalidTeam as error: assert "axes" in str(error)
else: raise AssertionError("a session takes axes that a scenario must not have")
assert session.change("a", "zone", center=[2, 0]).step(20).satisfied
""",
    "A protocol": """
r = cs.run("case-b", protocol="bounded-flow", until=200, start=(-1, 1))
assert r.summary["protocol"] == "bounded-flow" and r.summary["margin"] > -1, r.summary
from click.testing import CliRunner
from consat.cli.commands import cli
assert "bounded-flow" in CliRunner().invoke(cli, ["run", "--help"]).output
""",
    "An export": """
import pathlib, tempfile
with tempfile.TemporaryDirectory() as folder:
    path = cs.run("case-b", rounds=3).export(f"{folder}/run.jsonl")
    assert len(pathlib.Path(path).read_text().splitlines()) == 4
from click.testing import CliRunner
from consat.cli.commands import cli
assert ".jsonl" in CliRunner().invoke(cli, ["export", "--help"]).output
""",
    "A fault": """
from consat.faults import Faults
from consat.network.transports.memory import LATENCY, MemoryNetwork
network = MemoryNetwork(Faults(deaf=2))
one, other = network.endpoint("a", ["b"]), network.endpoint("b", ["a"])
for payload in (b"1", b"2", b"3"): one.send("b", payload)
network.now = LATENCY
network.deliver()
assert other.receive() == [b"3"]
""",
    "A transport": """
from consat.network.transports.counted import Counted
network = MemoryNetwork()
one = Counted(network.endpoint("a", ["b"]))
one.send("b", b"123")
assert one.sent == 3
import consat.network.deploy.process as process
assert process.Counted is Counted
""",
    "A figure": """
import tempfile
with tempfile.TemporaryDirectory() as folder:
    assert any(path.name == "speeds.png" for path in cs.run("case-b", rounds=3).plot(folder))
""",
}


def changes(section: str) -> Iterator[tuple[str, list[tuple[list[str], list[str]]] | str]]:
    """Of a section's diff each file: its text if it is new, else what stands there and what stands there instead."""
    (diff,) = re.findall(r"^```diff\n(.*?)^```$", section, flags=re.MULTILINE | re.DOTALL)
    for old, new, body in re.findall(r"^--- (\S+)\n\+\+\+ b/(\S+)\n(.*?)(?=^--- |\Z)", diff, flags=re.MULTILINE | re.DOTALL):
        if old == "/dev/null":
            lines = [line for line in body.splitlines() if not line.startswith("@@")]
            yield new, "\n".join(line[1:] for line in lines) + "\n"
            continue
        hunks = re.split(r"^@@.*@@\n", body, flags=re.MULTILINE)[1:]
        yield (
            new,
            [
                ([line[1:] for line in hunk.splitlines() if line[0] in " -"], [line[1:] for line in hunk.splitlines() if line[0] in " +"])
                for hunk in hunks
            ],
        )


def test_worked_diffs_work(tmp_path: Path) -> None:
    shutil.copytree(ROOT / "src" / "consat", tmp_path / "src" / "consat", ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    for title in USES:
        for name, change in changes(SECTIONS[title]):
            path = tmp_path / name
            if isinstance(change, str):
                assert not path.exists()
                path.write_text(change, encoding="utf-8")
                continue
            text = path.read_text(encoding="utf-8")
            for before, after in change:
                found = "\n".join(before)
                assert text.count(found) == 1, f"{name} has {text.count(found)} places like {found!r}"
                text = text.replace(found, "\n".join(after))
            path.write_text(text, encoding="utf-8")
    source = str(tmp_path / "src")
    code = "\n".join(
        [f"import sys; sys.path.insert(0, {source!r})", "import consat as cs", f"assert {source!r} in cs.__file__", *USES.values()]
    )
    tools, environment = Path(sys.executable).parent, os.environ | {"PYTHONPATH": source}
    for check in (["ruff", "check", "src"], ["ruff", "format", "--check", "src"], ["lint-imports", "--no-cache"]):
        said = subprocess.run([tools / check[0], *check[1:]], capture_output=True, text=True, check=False, cwd=tmp_path, env=environment)
        assert said.returncode == 0, said.stdout[-2000:] + said.stderr[-2000:]
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False, cwd=tmp_path, timeout=280)
    assert done.returncode == 0, done.stderr[-2000:]


def test_the_picture_of_the_rooms_is_that_of_the_code() -> None:
    done = subprocess.run([sys.executable, ROOT / "tools" / "architecture.py", "--check"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
