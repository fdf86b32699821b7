"""Commands around a run: export, show, doctor, the version, completion, and help with examples that work."""

from __future__ import annotations

import json
import os
import shlex
import sys
import tomllib
from pathlib import Path
from typing import Any

import click
import pytest
from click.shell_completion import BashComplete

import consat as cs
from consat.cli import doctor as commands_doctor
from consat.cli.commands import cli, main
from consat.cli.examples import EXAMPLES

ROOT = Path(__file__).parents[2]


@pytest.fixture
def typed(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Any:
    monkeypatch.chdir(tmp_path)

    def consat(*words: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["consat", *map(str, words)])
        monkeypatch.setattr(os, "environ", dict(os.environ))
        with pytest.raises(SystemExit) as left:
            main()
        code = left.value.code
        return (code if isinstance(code, int) else 0), *capsys.readouterr()

    return consat


def test_export_and_show_write_files_of_a_saved_result(typed, tmp_path: Path) -> None:
    cs.run("case-b", rounds=3, out=tmp_path / "b")
    assert typed("export", "b", "--to", "new/run.csv") == (0, "new/run.csv\n", "")
    assert len(Path("new/run.csv").read_text().splitlines()) == 1 + 4 * 3
    assert typed("show", "b") == (0, "b/result.html\n", "")
    assert typed("show", "b/result.nc", "--out", "page.html") == (0, "page.html\n", "")
    assert Path("page.html").read_text() == Path("b/result.html").read_text()
    code, out, err = typed("export", "b", "--to", "run.docx")
    assert (code, out) == (2, "")
    assert err == "consat: run.docx ends in .docx, but must end in one of .csv, .gif, .html, .mcap, .mp4\n"
    code, _, err = typed("show", "nothing.nc")
    assert code == 1
    assert err.startswith("consat: nothing.nc: there is no such file")


def test_a_missing_extra_exits_2_and_says_what_to_install(typed, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cs.run("case-b", rounds=3, out=tmp_path / "b")
    for module, words, extra in (
        ("foxglove", ["export", "b", "--to", "run.mcap"], "mcap"),
        ("av", ["export", "b", "--to", "run.mp4"], "video"),
        ("av", ["animate", "b", "--out", "run.mp4"], "video"),
    ):
        monkeypatch.setitem(sys.modules, module, None)
        code, out, err = typed(*words)
        assert (code, out) == (2, "")
        assert len(err.splitlines()) == 1
        assert f"pip install 'consat[{extra}]'" in err


def test_doctor_tells_what_a_bug_report_needs(typed, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", str(tmp_path / "cache"))
    (tmp_path / "cache").mkdir()
    (tmp_path / "cache" / "program").write_bytes(b"x" * 1000)
    code, out, err = typed("doctor", "--json")
    assert (code, err) == (0, "")
    told = json.loads(out)
    assert told["schema"] == "consat.doctor/1"
    assert told["version"] == cs.__version__
    assert told["libraries"]["jax"].startswith("0.")
    assert told["cache"] == {"place": str(tmp_path / "cache"), "files": 1, "bytes": 1000, "writable": True}
    assert told["loopback"]["reachable"]
    assert told["extras"]["network"]["installed"]
    monkeypatch.setattr(commands_doctor, "EXTRAS", {"moon": ("no-such-library",)})
    code, out, _ = typed("doctor")
    assert code == 0
    assert "consat[moon]    not installed: pip install 'consat[moon]'" in out.splitlines()


def test_doctor_knows_every_extra() -> None:
    optional = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    wanted = {
        extra: sorted(text.partition(">")[0] for text in needed)
        for extra, needed in optional.items()
        if extra not in {"all", "test", "docs"}
    }
    assert {extra: sorted(libraries) for extra, libraries in commands_doctor.EXTRAS.items()} == wanted


def test_doctor_fails_where_agents_cannot_talk(typed, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(commands_doctor, "_loopback", lambda: {"reachable": False, "port": 7447, "free": False})
    code, out, _ = typed("doctor")
    assert code == 1
    assert "does not work: agents as processes cannot talk; port 7447 taken: use --port" in out


def test_version_names_jax_and_the_device(typed) -> None:
    code, out, _ = typed("--version")
    assert code == 0
    assert out.startswith(f"consat {cs.__version__}, JAX 0.")
    assert "(cpu), Python 3." in out


# ---- help


def test_every_command_has_examples_and_its_help_is_whole(typed) -> None:
    assert set(EXAMPLES) == set(cli.commands)
    for name in cli.commands:
        code, out, _ = typed(name, "--help")
        assert code == 0
        for line in EXAMPLES[name]:
            assert f"    {line}" in out.splitlines()[-len(EXAMPLES[name]) :]
        assert "..." not in out
        assert "…" not in out.replace("v1,v2,…", "").replace("ID…", "")


@pytest.mark.parametrize("line", [line for lines in EXAMPLES.values() for line in lines])
def test_examples_are_understood(line: str) -> None:
    _, name, *words = shlex.split(line)
    context = cli.commands[name].make_context(name, list(words), parent=click.Context(cli, info_name="consat"))
    assert context.params


# ---- completion


def offered(*words: str) -> list[str]:
    *before, last = words
    return [item.value for item in BashComplete(cli, {}, "consat", "_CONSAT_COMPLETE").get_completions(before, last)]


def test_shells_are_offered_scenarios_files_protocols_and_agents(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "castle.yaml").write_text("consat: 1\nagents: [{id: north}, {id: nurse}, {id: south}]\ncommunication: {graph: line}\n")
    (tmp_path / "cargo").mkdir()
    (tmp_path / "cargo" / "ship.yml").touch()
    (tmp_path / "result.nc").touch()
    (tmp_path / "notes.txt").touch()
    assert offered("run", "ca") == ["case-a", "case-b", "case-c", "case-d", "case-e", "cargo/", "castle.yaml"]
    assert offered("check", "cargo/") == ["cargo/ship.yml"]
    assert offered("run", "case-b", "--protocol", "pro") == ["proportional-integral", "proximal"]
    assert offered("agent", "castle.yaml", "--id", "n") == ["north", "nurse"]
    assert offered("run", "castle.yaml", "--record", "north,") == ["north,nurse", "north,south"]
    assert offered("run", "missing.yaml", "--record", "n") == []
    assert offered("plot", "") == ["cargo/", "result.nc"]
    assert offered("dump") == []
    assert "doctor" in offered("do")
