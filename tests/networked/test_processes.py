"""Agents as processes over zenoh on loopback. Few, for each takes seconds to start; `test_rehearsal.py` has the many."""

import fcntl
import functools
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import consat as cs
from consat.network.deploy import output
from consat.network.deploy.commands import read_commands
from consat.network.deploy.fleet import Event, Fleet, free_ports
from consat.network.deploy.launch import Plan
from consat.network.deploy.observer import Observer
from consat.network.deploy.supervisor import Supervisor
from consat.network.node.part import Part, split
from consat.scenario import load
from tests.networked.case_c import GOAL
from tests.networked.oracle import ROUNDS

ROOT = Path(__file__).parents[2]
CONSAT = [sys.executable, "-c", "from consat.cli import main; main()"]
START = 90.0
"""A process has so long to start, or to end with what it has to say, s, on a busy machine."""


@pytest.fixture(autouse=True, scope="module")
def compiled_once(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """All agents here share what they compile."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("JAX_COMPILATION_CACHE_DIR", str(tmp_path_factory.mktemp("xla")))
        yield


def parts(name: str = "case-c") -> dict[str, Part]:
    ports = free_ports(3)
    addresses = {agent: f"tcp/127.0.0.1:{port}" for agent, port in zip(GOAL, ports, strict=True)}
    return split(load(name), run=f"test-{os.getpid()}-{ports[0]}", addresses=addresses)


def listen(fleet: Fleet, heard: list[Event], until: Callable[[], bool], seconds: float) -> None:
    """Listen until something has come true, which must be within `seconds`."""
    end = time.monotonic() + seconds
    while not until():
        assert time.monotonic() < end, f"too late; the last events were {heard[-3:]}"
        heard += fleet.poll(0.02)


def last(heard: list[Event], agent: str, kind: str = "report") -> Event | None:
    return next((event for event in reversed(heard) if event["id"] == agent and event["event"] == kind), None)


def reached(heard: list[Event], round_: int) -> bool:
    """Whether some agent has told of a round as late."""
    return any(event["event"] == "report" and event["track"] and event["track"][-1][0] >= round_ for event in heard)


def off(heard: list[Event]) -> float:
    """How far the team is from its optimum, as last reported."""
    reports = {agent: last(heard, agent) for agent in GOAL}
    return max(
        np.inf if report is None else np.abs(np.subtract(report["position"], GOAL[agent])).max() for agent, report in reports.items()
    )


def test_a_launch_carries_out_timed_commands(tmp_path: Path) -> None:
    """A goal is moved, a link comes, one goes, and an agent leaves: those who stay find each other again, and the result is of them."""
    file = tmp_path / "commands.yaml"
    file.write_text(
        "- {at: 0.3, agent: a1, command: change, constraint: goal, center: [1, 4]}\n"
        "- {at: 0.6, command: connect, agents: [a1, a3]}\n"
        "- {at: 0.9, command: disconnect, agents: [a2, a3]}\n"
        "- {at: 1.2, agent: a3, command: leave}\n"
    )
    command = [*CONSAT, "launch", "case-c", "--commands", str(file), "--json"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=START, check=False)
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert (result["status"], result["known"], result["ending"]) == ("satisfied", "satisfied", "satisfied")
    assert set(result["positions"]) == {"a1", "a2"}
    assert np.hypot(*np.subtract(result["positions"]["a1"], [1, 4])) < 1
    assert [each["name"] for each in result["agents"]["a2"]["constraints"]] == ["near(a1)"]
    assert result["motion"]["duration"] > 1.2


def test_launch_gathers_a_result_as_any_run(tmp_path: Path) -> None:
    robots = ["--set", "robots={kind: point, radius: 0.1, speed: 1}"]
    command = [*CONSAT, "launch", "case-c", *robots, "--mode", "admm", "--loss", "0.3", "--json", "--out", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=START, check=False)
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert result["schema"] == "consat.run/1"
    assert (result["status"], result["verdict"], result["ending"]) == ("satisfied", "feasible", "settled")
    for agent, goal in GOAL.items():
        np.testing.assert_allclose(result["positions"][agent], goal, atol=1e-3)
    assert result["network"]["loss"] == pytest.approx(0.3, abs=0.2)
    assert 0 < result["known_from"] == result["network"]["known_from"] < result["time"]
    assert result["satisfied_from"]["time"] <= result["network"]["known_from"] + 0.1  # who knows is right, up to a sample
    [warning] = result["warnings"]
    assert "launch simulates each robot as a point" in warning
    begin = cs.Result.load(result["result"]).data["position"].values[0]
    start = [part.first[part.team.ids.index(agent)] for agent, part in split(load("case-c")).items()]
    np.testing.assert_array_equal(begin, start)


def test_launch_ends_when_every_agent_knows_that_not_all_can_be_satisfied() -> None:
    """In the default mode: proven by themselves, and near the best that there is."""
    done = subprocess.run(
        [*CONSAT, "launch", "case-d", "--loss", "0.3", "--json"], capture_output=True, text=True, timeout=START, check=False
    )
    assert done.returncode == 4, done.stderr
    result = json.loads(done.stdout)
    assert (result["protocol"], result["mode"], result["known"]) == ("interior-point", "interior-point", "infeasible")
    assert (result["status"], result["verdict"], result["ending"]) == ("least-violating", "infeasible", "settled")
    assert result["margin"] == pytest.approx(-0.0814394, rel=0.05)
    assert 0 < result["known_from"] == result["network"]["known_from"] < result["time"]


def test_agents_end_by_themselves_when_they_know_all_that_there_is_to_find() -> None:
    """Each lingers, so that the others learn what it knows."""
    heard: list[Event] = []
    with Fleet(parts("case-d"), ["--stop", "satisfied", "--loss", "0.3"]) as fleet:
        for agent in GOAL:
            fleet.start(agent)
        listen(fleet, heard, lambda: all(last(heard, agent, "end") for agent in GOAL), START)
    assert {event["why"] for event in heard if event["event"] == "end"} == {"infeasible"}
    for agent in GOAL:
        told = last(heard, agent, "infeasible")
        assert told is not None
        assert told["near"]
        assert -0.0814394461 <= told["bound"] < 0 and told["margin"] == pytest.approx(-0.0814394, rel=0.06)  # noqa: PT018


RING = """
consat: 1
name: ring
agents:
  - {id: a, constraints: [{kind: within, center: [0, 0], radius: 0.5}]}
  - {id: b, constraints: [{kind: near, agent: a, radius: 0.5}]}
  - {id: c, constraints: [{kind: near, agent: b, radius: 0.5}, {kind: within, center: [4, 0], radius: 0.5}]}
  - {id: d, constraints: [{kind: near, agent: c, radius: 0.5}, {kind: near, agent: a, radius: 0.5}]}
communication: {graph: ring}
"""


def test_a_torn_team_whose_links_form_a_loop_goes_over_to_a_tree_and_proves_that_it_is(tmp_path: Path) -> None:
    """Along its loop nobody can prove it, and the launch would end undecided."""
    (tmp_path / "ring.yaml").write_text(RING)
    command = [*CONSAT, "launch", str(tmp_path / "ring.yaml"), "--json"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=START, check=False)
    assert done.returncode == 4, done.stderr
    result = json.loads(done.stdout)
    assert (result["status"], result["known"], result["ending"]) == ("least-violating", "infeasible", "settled")
    assert (result["route"], result["network"]["ended"]) == ("tree", [])
    assert result["margin"] == pytest.approx(-0.75, rel=0.05)  # two discs and two links share a distance of 4: 0.5² − 1²


@pytest.fixture(scope="module")
def truth() -> dict[str, np.ndarray]:
    """(T, d) of each agent, as `simulate` has it when every product is rounded by itself."""
    environment = os.environ | {
        "XLA_FLAGS": "--xla_cpu_max_isa=AVX",
        "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]),
    }
    done = subprocess.run(
        [sys.executable, "-m", "tests.networked.oracle", "truth"], cwd=ROOT, env=environment, capture_output=True, timeout=START, check=True
    )
    told = json.loads(done.stdout)
    return dict(zip(told["ids"], np.array(told["truth"]).swapaxes(0, 1), strict=True))


def test_lockstep_equals_simulate_bit_for_bit(truth: dict[str, np.ndarray], tmp_path: Path) -> None:
    """Although two agents are ended by SIGKILL on the way, and start again from what they have on disk."""
    options = ["--mode", "lockstep", "--rounds", str(ROUNDS), "--loss", "0.3", "--report", "0", "--rate", "50"]
    kills = ("a2", "a1")
    heard: list[Event] = []
    with Fleet(parts(), options, exact=True) as fleet:

        def start(agent: str) -> None:
            fleet.start(agent, "--memory", str(tmp_path / agent), "--seed", str(ord(agent[-1])))

        for agent in GOAL:
            start(agent)
        for number, agent in enumerate(kills, 1):
            listen(fleet, heard, functools.partial(reached, heard, 30 * number), START)
            fleet.kill(agent)
            start(agent)
        listen(fleet, heard, lambda: all(last(heard, agent, "finished") for agent in GOAL), START)
    resumed = [event["id"] for event in heard if event["event"] == "resumed"]
    assert resumed == list(kills)
    for agent, positions in truth.items():
        track = {int(number): place for e in heard if e["id"] == agent and e["event"] == "report" for number, *place in e["track"]}
        assert len(track) >= ROUNDS - len(kills)  # a round may be taken and not told of before the end
        assert ROUNDS in track
        assert max(np.abs(positions[number] - place).max() for number, place in track.items()) == 0.0


def test_a_crash_is_noticed_at_once_and_mended_without_memory() -> None:
    heard: list[Event] = []
    with Fleet(parts(), ["--mode", "admm", "--loss", "0.3"]) as fleet:
        for agent in GOAL:
            fleet.start(agent)
        listen(fleet, heard, lambda: off(heard) < 1e-3, START)
        fleet.kill("a2")
        killed = time.monotonic()
        listen(fleet, heard, lambda: all((e := last(heard, a, "down")) and e["t"] >= killed - 0.1 for a in ("a1", "a3")), 10.0)
        noticed = max(event["t"] for event in heard if event["event"] == "down" and event["peer"] == "a2")
        assert noticed - killed < 1.0
        fleet.start("a2", "--position", "5,5")
        listen(fleet, heard, lambda: (e := last(heard, "a2")) is not None and e["t"] > killed and off(heard) > 1.0, START)
        listen(fleet, heard, lambda: off(heard) < 1e-3, START)


def test_an_agent_told_to_leave_goes_and_the_others_stay() -> None:
    heard: list[Event] = []
    with Fleet(parts(), ["--mode", "admm"]) as fleet:
        for agent in GOAL:
            fleet.start(agent)
        listen(fleet, heard, lambda: off(heard) < 1e-3, START)
        fleet.tell("a3", {"command": "leave"})
        listen(fleet, heard, lambda: last(heard, "a3", "end") is not None and last(heard, "a2", "left") is not None, 30.0)
        listen(fleet, heard, lambda: np.abs(np.subtract(last(heard, "a1")["position"], [2, 0])).max() < 1e-3, 30.0)  # type: ignore[index]
        assert not fleet.running("a3") or fleet.exit_code("a3") in {None, 0}


def children(pid: int) -> list[int]:
    return list(map(int, Path(f"/proc/{pid}/task/{pid}/children").read_text().split()))


@pytest.fixture
def ctrl_c() -> Iterator[None]:
    """Whoever is started hears Ctrl-C. Under nohup, and in the background of a script, it is ignored, which is handed on."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.mark.usefixtures("ctrl_c")
def test_launch_mends_what_crashes_and_ctrl_c_leaves_nothing_behind(tmp_path: Path) -> None:
    command = [*CONSAT, "launch", "case-c", "--until", "600", "--json"]
    with (tmp_path / "out").open("wb") as out, subprocess.Popen(command, stdout=out) as launch:
        try:
            end = time.monotonic() + START
            while len(children(launch.pid)) < 3 or not any(map(_listens, children(launch.pid))):
                assert time.monotonic() < end
                time.sleep(0.1)
            agents = children(launch.pid)
            os.kill(agents[0], signal.SIGKILL)
            while len(agents) < 4:
                assert time.monotonic() < end
                agents += [pid for pid in children(launch.pid) if pid not in agents]
                time.sleep(0.05)
            launch.send_signal(signal.SIGINT)
            assert launch.wait(START) == 130
        finally:
            launch.kill()
    told = json.loads((tmp_path / "out").read_text())
    assert told["ending"] == "interrupted"
    [ended] = told["network"]["ended"]
    assert (ended["how"], ended["restarted"]) == ("SIGKILL", True)
    assert f"the process of agent {ended['agent']!r} ended (SIGKILL)" in told["warnings"][0]
    assert not [pid for pid in agents if Path(f"/proc/{pid}").exists()]


def test_who_ends_without_being_told_to_is_started_again_and_knows_what_it_knew() -> None:
    """After a plain kill as after SIGKILL, and whoever ended is named. One that was told to leave stays away."""
    scenario = load("case-c")
    team, those = scenario.team, parts()
    script = read_commands("- {at: 0, agent: a3, command: leave}", "commands", team, "interior-point")
    observer = Observer(team, np.array([those[agent].first[those[agent].team.ids.index(agent)] for agent in GOAL]), "time")
    with Fleet(those) as fleet:
        supervisor = Supervisor(fleet, observer, Plan(), scenario, script, those)

        def go_on(until: Callable[[], bool]) -> None:
            end = time.monotonic() + START
            while not until():
                assert time.monotonic() < end, supervisor.endings(0.0)
                observer.take(fleet.poll(0.05))
                supervisor.restart_ended()
                supervisor.advance()

        def known() -> bool:
            return supervisor.done == 1 and observer.all_known()[0] == "satisfied" and observer.records["a3"].ended is not None

        for agent in GOAL:
            supervisor.start(agent)
        go_on(known)
        for number, (agent, how) in enumerate((("a2", signal.SIGTERM), ("a1", signal.SIGKILL)), 1):
            os.kill(fleet.pid(agent), how)
            go_on(lambda number=number: len(supervisor.endings(0.0)) == number)  # type: ignore[misc]
            assert not known()
            go_on(known)
        os.kill(fleet.pid("a1"), signal.SIGTERM)
        listen(fleet, [], lambda: fleet.exit_code("a1") is not None, START)
        told = [(each["agent"], each["how"], each["restarted"]) for each in supervisor.endings(0.0)]
        assert told == [("a2", "SIGTERM", True), ("a1", "SIGKILL", True), ("a1", "exit code 0", False)]


def _listens(pid: int) -> bool:
    """Whether a process has got as far as zenoh's threads."""
    return len(list(Path(f"/proc/{pid}/task").iterdir())) > 6


SOLO = """
consat: 1
agents:
  - {id: solo, start: [3, 1], constraints: [{kind: within, center: [0, 0], radius: 1}]}
"""


def test_an_agent_follows_its_sensor_under_its_speed_limit(tmp_path: Path) -> None:
    """Its position is measured by somebody else, here on the way from (3, 4) to the centre of the disc; it commands velocities, and at the
    end to stand."""
    (tmp_path / "solo.yaml").write_text(SOLO)
    port = str(free_ports(1)[0])
    command = [*CONSAT, "agent", str(tmp_path / "solo.yaml"), "--id", "solo", "--sensor", "stdin", "--speed", "0.5", "--port", port]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as agent:
        try:
            assert agent.stdin is not None
            assert agent.stdout is not None
            agent.stdin.write('what is this\n{"position": [3, NaN]}\n')
            events: list[dict[str, Any]] = []
            for line in agent.stdout:
                agent.stdin.write('{"position": [3, 4]}\n')
                agent.stdin.flush()
                events.append(json.loads(line))
                if events[-1]["event"] == "command" and np.linalg.norm(events[-1]["velocity"]) > 0.4:
                    break
            agent.send_signal(signal.SIGTERM)
            rest = [json.loads(line) for line in agent.stdout]
            assert agent.wait(START) == 0  # while its stdin is open, and a thread waits for what comes there
        finally:
            agent.kill()
    commands = [event for event in rest if event["event"] == "command"]
    assert (commands[-1]["velocity"], commands[-1]["valid_for"]) == ([0.0, 0.0], 0.5)
    assert {event["line"] for event in [*events, *rest] if event["event"] == "rejected"} == {"what is this", '{"position": [3, NaN]}'}
    np.testing.assert_allclose(events[-1]["velocity"], [-0.3, -0.4], atol=0.02)  # towards the disc, no faster than allowed


def test_an_agent_whose_output_nobody_reads_goes_on_and_ends_when_told(tmp_path: Path) -> None:
    (tmp_path / "solo.yaml").write_text(SOLO)
    command = [*CONSAT, "agent", str(tmp_path / "solo.yaml"), "--id", "solo", "--sensor", "stdin", "--speed", "0.5", "--report", "0"]
    with subprocess.Popen([*command, "--port", str(free_ports(1)[0])], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as agent:
        try:
            assert agent.stdin is not None
            assert agent.stdout is not None
            fcntl.fcntl(agent.stdout, fcntl.F_SETPIPE_SZ, 4096)
            while json.loads(agent.stdout.readline())["event"] != "start":
                pass
            for _ in range(60):  # a report takes 400 bytes, and 100 of them come in a second
                agent.stdin.write('{"position": [3, 4]}\n')
                agent.stdin.flush()
                time.sleep(0.05)
            agent.send_signal(signal.SIGTERM)
            assert agent.wait(10) == 0
        finally:
            agent.kill()


def test_of_commands_that_wait_the_newest_is_written(monkeypatch: pytest.MonkeyPatch) -> None:
    written: list[str] = []
    free = threading.Event()
    monkeypatch.setattr(output, "_write", lambda line: (written.append(line), free.wait(10)))
    with output.Output() as out:
        out.write({"event": "start"})
        while not written:
            time.sleep(0.01)
        for k in range(5):
            out.write({"event": "command", "k": k})
            out.write({"event": "report", "k": k})
        free.set()
    told = [json.loads(line) for line in written]
    assert [each["k"] for each in told if each["event"] == "report"] == [0, 1, 2, 3, 4]
    assert [each["k"] for each in told if each["event"] == "command"] == [4]
