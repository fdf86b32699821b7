"""What people type: a mistake is told once, in a line, with the cure, and exits as it should; nothing is overwritten unasked."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

import consat as cs
from consat.cli.commands import cli, main
from consat.views import animation


def consat(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, *words: object) -> tuple[int, str, str]:
    """The exit code, stdout and stderr of a command."""
    monkeypatch.setattr(sys, "argv", ["consat", *map(str, words)])
    monkeypatch.setattr(os, "environ", dict(os.environ))
    with pytest.raises(SystemExit) as left:
        main()
    return int(left.value.code or 0), *capsys.readouterr()  # type: ignore[return-value]


@pytest.fixture
def typed(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path):
    monkeypatch.chdir(tmp_path)
    return lambda *words: consat(capsys, monkeypatch, *words)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["sweep", "case-c", "--over", "loss=0,foo"], "consat: loss is 'foo', but must be a probability below 1, such as 0.3"),
        (["sweep", "case-c", "--over", "loss=[1]"], "consat: loss is [1], but must be a probability below 1, such as 0.3"),
        (["sweep", "case-c", "--over", "sleep=true"], "consat: sleep is True, but must be a probability below 1, such as 0.3"),
        (["sweep", "case-c", "--over", "loss=.nan"], "consat: loss is nan, but must be a probability below 1, such as 0.3"),
        (["sweep", "case-c", "--over", "loss=0:1:2"], "consat: loss is 1.0, but must be a probability below 1, such as 0.3"),
        (
            ["sweep", "case-c", "--over", "loss=0:1:1000000000"],
            "consat: '0:1:1000000000' is no range; FROM and TO must be finite, and COUNT",
        ),
        (["sweep", "case-c", "--over", "loss=0:.inf:3"], "consat: '0:.inf:3' is no range; write FROM:TO:COUNT"),
        (["sweep", "case-c", "--over", "loss=0:inf:3"], "consat: '0:inf:3' is no range; FROM and TO must be finite"),
        (["sweep", "case-c", "--over", "loss=0", "--over", "loss=0.1"], "Error: --over loss is given twice; write all its values in one"),
        (
            ["launch", "case-c", "--mode", "admm", "--protocol", "max-min"],
            "consat: mode admm runs the protocol admm, but the protocol is max-min; mode lockstep",
        ),
        (
            ["launch", "case-c", "--mode", "link", "--protocol", "admm"],
            "consat: mode link runs the protocol gradient-flow, but the protocol is",
        ),
        (
            ["launch", "case-c", "--mode", "lockstep", "--protocol", "gradient-flow"],
            "consat: mode lockstep runs protocols in rounds, interior-point, max-min, admm, proximal, but",
        ),
        (["launch", "case-c", "--pace", "2"], "consat: mode interior-point has no time of its own; only link takes a pace"),
        (
            ["init", "case-z"],
            "Error: there is no packaged scenario 'case-z'; did you mean 'case-e'? For an empty scenario of that name: consat ",
        ),
        (["init", "lattices"], "Error: there is no packaged scenario 'lattices'; did you mean 'lattice'?"),
    ],
)
def test_wrong_usage_is_told_once_and_exits_2(typed, words: list[str], said: str, tmp_path: Path) -> None:
    code, out, err = typed(*words)
    assert code == 2
    assert out == ""
    told = [line for line in err.splitlines() if not line.startswith(("Usage:", "Try ")) and line]
    assert len(told) == 1
    assert told[0].startswith(said)
    assert list(tmp_path.iterdir()) == []


def test_init_writes_what_is_no_typing_mistake(typed, tmp_path: Path) -> None:
    for name, file in (("case-b", "case-b.yaml"), ("warehouse", "warehouse.yaml"), ("case-z.yaml", "case-z.yaml")):
        assert typed("init", name)[0] == 0
        cs.load(tmp_path / file)
    assert cs.load(tmp_path / "case-b.yaml").name == "case-b"


def test_no_summary_of_a_command_is_cut_off(typed) -> None:
    code, out, _ = typed("--help")
    assert code == 0
    lines = out.partition("Commands:\n")[2].splitlines()
    assert [line.split()[0] for line in lines] == sorted(cli.commands)
    assert not [line for line in lines if line.endswith(("...", "…"))]
    assert all(line.endswith(".") for line in lines)


def test_plot_and_animate_take_the_directory_of_a_run(typed, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    cs.run("case-b", rounds=3, out=tmp_path / "b")
    code, out, _ = typed("plot", "b")
    assert code == 0
    drawn = [Path(line) for line in out.splitlines()]
    assert {path.parent for path in drawn} == {Path("b")}
    monkeypatch.setattr(animation, "save", lambda result, path, progress: f"{result.summary['rounds']} rounds in {path}")
    assert typed("animate", "b") == typed("animate", "b/result.nc") == (0, "3 rounds in b/result.gif\n", "")
    code, _, err = typed("plot", tmp_path)
    assert code == 1
    assert err.startswith(f"consat: {tmp_path / 'result.nc'}: there is no such file")
    assert cs.Result.load(tmp_path / "b").summary["scenario"] == "case-b"


def test_results_of_another_scenario_are_not_overwritten_unless_one_says_so(typed, tmp_path: Path) -> None:
    cs.run("case-b", rounds=0, out=tmp_path / "run")
    cs.sweep("case-b", rounds=0).save(tmp_path / "sweep")
    cs.run("case-b", rounds=0, out=tmp_path / "kept", checkpoint=0.0)
    (tmp_path / "kept" / "result.nc").unlink()  # as if the run had been killed
    (tmp_path / "strange").mkdir()
    (tmp_path / "strange" / "result.nc").write_text("not ours")
    for folder in ("run", "sweep", "kept"):
        refused = f"consat: {folder} holds results of another scenario, 'case-b'; choose another folder, or overwrite it with --force"
        for words in (["run", "case-c", "--rounds", 0], ["sweep", "case-c", "--rounds", 0], ["launch", "case-c"]):
            code, _, err = typed(*words, "--out", folder)
            assert code == 2
            assert err.startswith(refused)
    code, _, err = typed("run", "case-c", "--rounds", 0, "--out", "strange")
    assert code == 2
    assert err.startswith("consat: strange/result.nc is not of consat, and would be overwritten; choose")
    with pytest.raises(cs.InvalidSettings, match="force=True"):
        cs.run("case-c", rounds=0, out=tmp_path / "run")
    assert cs.Result.load(tmp_path / "run").summary["scenario"] == "case-b"
    # one's own may be written again, and others if one says so
    cs.run("case-b", rounds=1, out=tmp_path / "run")
    assert cs.Result.load(tmp_path / "run").summary["rounds"] == 1
    assert typed("run", "case-c", "--rounds", 0, "--out", "run", "--force")[0] == 4
    assert cs.Result.load(tmp_path / "run").summary["scenario"] == "case-c"
    cs.run("case-c", rounds=0, out=tmp_path / "strange", force=True)
    assert cs.Result.load(tmp_path / "strange").summary["scenario"] == "case-c"


def test_a_folder_that_cannot_be_written_is_refused_before_the_run(typed, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")

    def never(*_: float) -> None:
        raise AssertionError("the run has begun")

    for folder in ("/proc/x", tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(cs.ConsatError, match=rf"^results cannot be written to {re.escape(str(folder))} \("):
            cs.run("case-b", out=folder, progress=never)
    for words in (["run", "case-b"], ["sweep", "case-b"], ["launch", "case-b"]):
        refused = "consat: results cannot be written to file/below (Not a directory); choose another folder\n"
        assert typed(*words, "--out", "file/below") == (2, "", refused)


FORK = """
import os, signal, sys, warnings
warnings.simplefilter("ignore")
import consat as cs
if sys.argv[1] == "jax":
    import jax.numpy as jnp
    jnp.zeros(3).block_until_ready()
elif sys.argv[1] == "consat":
    cs.Team([cs.Agent("a", [cs.within([0, 0], 1)])])
    cs.solve("case-a")
child = os.fork()
if child:
    sys.exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
signal.alarm(30)  # whoever hangs all the same ends
try:
    told = cs.run("case-a", rounds=0).summary["rounds"]
except cs.ConsatError as error:
    told = error
print(told, flush=True)
os._exit(0)
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system has no fork")
@pytest.mark.parametrize(
    ("used", "said"), [("jax", "start processes with spawn"), ("consat", "start processes with spawn"), ("nothing", "0")]
)
def test_a_fork_of_a_process_that_uses_jax_is_refused_at_once(used: str, said: str) -> None:
    done = subprocess.run([sys.executable, "-c", FORK, used], capture_output=True, text=True, timeout=60, check=True)
    assert said in done.stdout
