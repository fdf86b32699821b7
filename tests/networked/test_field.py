"""Agents in the field: their bodies are what counts, a robot is left standing, and no measurement that cannot be is believed."""

import json
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest

from consat.errors import InvalidSettings
from consat.faults import Faults
from consat.network.deploy import process
from consat.network.deploy.process import ProcessOptions, run_agent
from consat.network.deploy.rehearsal import Rehearsal
from consat.network.node.body import VALID
from consat.network.node.commander import PERIOD
from consat.network.node.modes import NodeSettings
from consat.network.node.part import Part, split
from consat.network.node.station import Station
from consat.network.transports.memory import MemoryNetwork
from consat.numerics import float64
from consat.problem.objective import Objective
from consat.scenario import load, loads
from tests.networked.case_c import events, parts, rehearse

# -- the whole team: what counts is where bodies are -----------------------------------------------------------------------------------

SPEED = 0.5
MODES = {
    "admm": NodeSettings("admm", report=0.0),
    "interior-point": NodeSettings("interior-point", report=0.0),
    "link": NodeSettings("link", pace=20.0, report=0.0),
    "lockstep": NodeSettings("lockstep", rate=100.0, report=0.0),
}


@float64
def margin(positions: dict[str, np.ndarray]) -> float:
    team = load("case-c").team
    return float(Objective.at_positions(team).agent_margins(jnp.asarray(np.stack([positions[agent] for agent in team.ids]))).min())


@pytest.mark.parametrize("mode", MODES)
def test_agents_are_satisfied_when_their_bodies_are(mode: str) -> None:
    """The estimates satisfy everything within tenths of a second, the bodies need some ten."""
    team = rehearse(MODES[mode], Faults(loss=0.3), speed=SPEED)
    team.run(30.0, lambda: bool(events(team, "satisfied")))
    assert margin(team.positions()) > 0
    early = [event for event in events(team, "report") if event["estimate_margin"] is not None and event["t"] < 5.0]  # type: ignore[operator]
    assert any(all(event["estimate_margin"] > 0 for event in early[k : k + 3]) for k in range(len(early))), "negative control"
    assert events(team, "satisfied")[0]["t"] > 5.0  # type: ignore[operator]
    team.run(30.0, lambda: len({event["id"] for event in events(team, "satisfied")}) == 3)
    assert {event["id"] for event in events(team, "satisfied")} == {"a1", "a2", "a3"}


def test_a_report_has_the_margin_at_its_position() -> None:
    """That of a1 depends on its own position alone."""
    team = rehearse(MODES["admm"], speed=SPEED)
    team.run(12.0)
    told = [event for event in events(team, "report") if event["id"] == "a1" and event["margin"] is not None]
    assert len(told) > 1000
    for event in told:
        assert event["margin"] == pytest.approx(1 - np.sum(np.square(np.subtract(event["position"], [2, 0]))), abs=1e-12)  # type: ignore[arg-type]
    gaps = [abs(event["margin"] - event["estimate_margin"]) for event in told]  # type: ignore[operator]
    assert gaps[100] > 1
    assert gaps[-1] < 1e-6, "once the body is where it should be the two are one"


def test_a_body_is_heard_of_over_relays() -> None:
    """a1 must stay near a3, two links away; whom it hears of from a2 alone, who is told nothing else of a1's constraints."""
    scenario = loads("""
consat: 1
agents:
  - {id: a1, start: [6, 0], constraints: [{kind: near, agent: a3, radius: 1}]}
  - {id: a2, start: [0, 3], constraints: [{kind: near, agent: a1, radius: 9}]}
  - {id: a3, start: [-6, 0], constraints: [{kind: within, center: [0, 0], radius: 1}]}
communication: {graph: line}
smoothing: {nu_alpha: 5, nu_beta: 5}
""")
    team = Rehearsal(
        split(scenario, run="relays"), NodeSettings("admm", report=0.0), MemoryNetwork(Faults(loss=0.3, delay=(0.0, 0.05))), speed=1.0
    )
    team.start()
    team.run(20.0, lambda: bool(events(team, "satisfied")))
    where = team.positions()
    assert np.linalg.norm(where["a1"] - where["a3"]) < 1
    assert np.linalg.norm(where["a3"]) < 1
    told = [event for event in events(team, "report") if event["id"] == "a1" and event["margin"] is not None]
    tracks = {agent: {event["t"]: event["position"] for event in events(team, "report") if event["id"] == agent} for agent in where}
    for event in told[::50]:  # at the positions of a1 now, and of a3 some 0.1 s ago
        lately = [position for t, position in tracks["a3"].items() if event["t"] - 0.5 <= t <= event["t"]]  # type: ignore[operator]
        found = [1 - np.sum(np.square(np.subtract(event["position"], position))) for position in lately]  # type: ignore[arg-type]
        assert min(np.abs(np.subtract(found, event["margin"]))) < 0.05


def test_no_one_is_satisfied_whose_body_is_lost() -> None:
    team = rehearse(MODES["admm"])
    team.run(5.0)
    assert all(runner.station.known == "satisfied" for runner in team.runners.values())
    team.bodies["a2"].sensed = lambda now: False  # type: ignore[method-assign]
    team.run(0.5)
    assert not any(runner.station.known == "satisfied" for runner in team.runners.values())
    del team.bodies["a2"].sensed
    team.run(0.5)
    assert all(runner.station.known == "satisfied" for runner in team.runners.values())


def test_in_lockstep_nobody_who_waits_stays_satisfied() -> None:
    team = rehearse(NodeSettings("lockstep", rate=100.0))
    team.run(5.0)
    assert all(runner.station.known == "satisfied" for runner in team.runners.values())
    team.kill("a3")
    team.run(1.0)
    assert not any(runner.station.known == "satisfied" for runner in team.runners.values())


# -- one agent and its robot ---------------------------------------------------------------------------------------------------------------

SOLO = loads("""
consat: 1
agents:
  - {id: solo, start: [3, 1], constraints: [{kind: within, center: [0, 0], radius: 1}]}
""")
PATIENCE = 30.0
"""Seconds after which an agent ends whatever happens."""


class Robot:
    """Stands at (3, 4), five lengths from the centre of the disc, and acts on events: each turn of the script gets the events so far."""

    def __init__(self, stdin: int) -> None:
        self.stdin = stdin
        self.told: list[dict[str, Any]] = []
        self.script: Callable[[Robot], Any] = lambda _: None

    def take(self, event: dict[str, Any]) -> None:
        self.told.append(json.loads(json.dumps(event)))
        self.script(self)

    def say(self, line: str | dict[str, Any]) -> None:
        os.write(self.stdin, (line if isinstance(line, str) else json.dumps(line)).encode() + b"\n")

    def measure(self, *position: float, **more: Any) -> None:
        self.say({"position": list(position or (3.0, 4.0)), **more})

    def of(self, kind: str) -> list[dict[str, Any]]:
        return [event for event in self.told if event["event"] == kind]

    def drives(self) -> bool:
        return bool(self.of("command")) and bool(np.any(self.of("command")[-1]["velocity"]))


@pytest.fixture
def robot(monkeypatch: pytest.MonkeyPatch) -> Iterator[Robot]:
    """The agent runs in this process: its stdin is a pipe, its stdout the robot, its network the air."""
    read, write = os.pipe()
    made = Robot(write)

    @contextmanager
    def transport(*_: Any) -> Iterator[Any]:
        yield Waiting(MemoryNetwork().endpoint("solo", []))

    monkeypatch.setattr(process, "Output", lambda: nullcontext(SimpleNamespace(write=made.take)))
    monkeypatch.setattr(process, "_transport", transport)
    with os.fdopen(read) as stdin:
        monkeypatch.setattr(sys, "stdin", stdin)
        yield made
        os.close(write)
        time.sleep(0.01)  # the thread that reads sees the end


class Waiting:
    """A transport that waits in real time."""

    def __init__(self, inner: Any) -> None:
        self.receive, self.alive = inner.receive, inner.alive

    def wait(self, seconds: float) -> None:
        time.sleep(seconds)


def run(again: Callable[[], Part] | None = None, **around: Any) -> None:
    part = split(SOLO, run="solo")["solo"]
    run_agent(
        part,
        NodeSettings("admm", around.pop("rate", 20.0), turns=around.pop("turns", None)),
        ProcessOptions(**{"sensor": "stdin", "speed": 0.5, "until": PATIENCE} | around),
        again,
    )


def keep_measuring(robot: Robot) -> None:
    """A sensor that never fails."""
    if robot.told[-1]["event"] == "command":
        robot.measure()


def stand(robot: Robot) -> bool:
    """Whether the last command is to stand, and nothing but the farewell comes after it."""
    after = [event["event"] for event in robot.told[robot.told.index(robot.of("command")[-1]) :]]
    return not robot.drives() and set(after) <= {"command", "report", "end"}


ENDS: dict[str, tuple[dict[str, Any], Callable[[Robot], Any], str]] = {
    "told to stop": ({}, lambda robot: robot.say({"command": "stop"}), "told to stop"),
    "SIGTERM": ({}, lambda _: os.kill(os.getpid(), signal.SIGTERM), "SIGTERM"),
    "Ctrl-C": ({}, lambda _: os.kill(os.getpid(), signal.SIGINT), "SIGINT"),
    "hangup": ({}, lambda _: os.kill(os.getpid(), signal.SIGHUP), "SIGHUP"),
    "leaves": ({}, lambda robot: robot.say({"command": "leave"}), "done"),
    "out of time": ({"until": 0.5}, lambda _: None, "out of time"),
    "out of turns": ({"turns": 10}, lambda _: None, "done"),
}


@pytest.mark.parametrize("end", ENDS)
def test_whatever_ends_an_agent_its_robot_stands(end: str, robot: Robot, request: pytest.FixtureRequest) -> None:
    heard = signal.signal(signal.SIGHUP, signal.SIG_DFL)  # ignored, and rightly so, where the tests were started by nohup
    request.addfinalizer(lambda: signal.signal(signal.SIGHUP, heard))
    around, act, why = ENDS[end]
    acted: list[bool] = []

    def script(robot: Robot) -> None:
        keep_measuring(robot)
        if robot.drives() and not acted:
            acted.append(True)
            act(robot)

    robot.script = script
    run(**around)
    assert acted, "it drove"
    assert stand(robot)
    assert robot.told[-1]["event"] == "end"
    assert robot.told[-1]["why"] == why
    if end == "leaves":
        left = next(
            k
            for k, event in enumerate(robot.told)
            if k > robot.told.index(robot.of("command")[1]) and event["event"] == "command" and not any(event["velocity"])
        )
        assert not any(any(event["velocity"]) for event in robot.told[left:] if event["event"] == "command"), (
            "while it says farewell it stands"
        )


def test_an_agent_that_fails_leaves_its_robot_standing(robot: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    def watch(_: Station) -> float:
        if robot.drives():
            raise ZeroDivisionError
        return 0.0

    monkeypatch.setattr(Station, "watch", watch)
    robot.script = keep_measuring
    with pytest.raises(ZeroDivisionError):
        run()
    assert not robot.drives()
    assert any(any(event["velocity"]) for event in robot.of("command"))


def test_commands_say_how_long_they_are_valid_and_come_in_time(robot: Robot) -> None:
    robot.script = keep_measuring
    run(until=2.0, rate=1.0)
    commands = robot.of("command")
    assert {event["valid_for"] for event in commands} == {VALID}
    assert commands[0]["velocity"] == [0.0, 0.0], "the first, before anything is known, is to stand"
    times = [event["t"] for event in commands[1:]]
    assert len(times) >= 10, "more often than there are turns"
    assert np.median(np.diff(times)) < 2 * PERIOD < VALID


def test_without_measurements_the_robot_stands_and_then_goes_on(robot: Robot, capsys: pytest.CaptureFixture[str]) -> None:
    """The sensor fails after five commands to drive, and is back after five to stand."""

    def after(kind: str) -> list[bool]:
        """Whether the robot drove, at each command after an event."""
        begin = next((k for k, event in enumerate(robot.told) if event["event"] == kind), len(robot.told))
        return [any(event["velocity"]) for event in robot.told[begin:] if event["event"] == "command"]

    def script(robot: Robot) -> None:
        if robot.told[-1]["event"] != "command":
            return
        if any(after("measured")):
            robot.say({"command": "stop"})
        elif sum(after("command")) < 5 or len(after("unmeasured")) >= 5:
            robot.measure()

    robot.script = script
    run(sensor_timeout=0.3)
    assert [event["event"] for event in robot.told if event["event"] in {"unmeasured", "measured"}] == ["unmeasured", "measured"]
    lost, found = robot.of("unmeasured")[0]["t"], robot.of("measured")[0]["t"]
    blind = [event["velocity"] for event in robot.of("command") if lost <= event["t"] < found]
    assert len(blind) >= 5
    assert not np.any(blind)
    driven = [event["t"] for event in robot.of("command") if any(event["velocity"])]
    assert lost - driven[0] > 0.3, "so long it believes the last one"
    assert capsys.readouterr().err.splitlines() == [
        "consat: agent 'solo' has no measurement for 0.3 s, and stands", "consat: agent 'solo' is measured again",
    ]  # fmt: skip


def test_a_robot_never_measured_is_told_of_once(robot: Robot) -> None:
    run(until=0.5, sensor_timeout=0.1)
    assert len(robot.of("unmeasured")) == 1
    assert not np.any([event["velocity"] for event in robot.of("command")])


REFUSED = {
    "what is this": "it is no JSON",
    "[1, 2]": 'it must be {"position": [...]}',
    '{"command": "fly"}': "there is no command 'fly'; the commands are stop, leave",
    "[" * 9999: "it is no JSON",
    '{"position": [3, NaN]}': "position must be a list of 2 finite numbers",
    '{"position": [3, Infinity]}': "position must be a list of 2 finite numbers",
    '{"position": [3, 1e101]}': "position must be a list of 2 finite numbers",
    '{"position": [3, true]}': "position must be a list of 2 finite numbers",
    '{"position": [3, "4"]}': "position must be a list of 2 finite numbers",
    '{"position": [3, 4, 0]}': "position must be a list of 2 finite numbers",
    '{"position": [3]}': "position must be a list of 2 finite numbers",
    '{"position": null}': "position must be a list of 2 finite numbers",
    '{"position": [3, 4], "stamp": "now"}': "stamp must be a finite number",
    '{"position": [3, 4], "stamp": NaN}': "stamp must be a finite number",
    '{"position": [3, 4], "stamp": 6}': "its stamp is 6, but must be above 7, the last one",
    '{"position": [3, 4], "stamp": 7}': "its stamp is 7, but must be above 7, the last one",
    '{"position": [30, 4], "stamp": 8}': "it is 27 from the last one, ",
}


def test_each_line_that_cannot_be_is_refused_with_the_reason_and_the_last_good_position_stays(robot: Robot) -> None:
    robot.measure(3, 4, stamp=7)
    for line in REFUSED:
        robot.say(line)
    rest = b"\xff\xfe not UTF-8\n" + b"x" * 200_000 + b'\n{"command": "stop"}\n'
    threading.Thread(target=os.write, args=(robot.stdin, rest)).start()  # more than fits into a pipe
    run()
    told = [(event["line"], event["why"]) for event in robot.of("rejected")]
    for line, why in REFUSED.items():
        assert next(reason for shown, reason in told if shown == line[:80]).startswith(why), line
    assert len(told) == len(REFUSED) + 2
    assert robot.of("report")[-1]["position"] == [3.0, 4.0]


def test_a_simulated_body_takes_no_measurements_and_gets_no_commands(robot: Robot) -> None:
    robot.measure()
    run(sensor="simulated", attached=True, until=0.2)
    assert [event["why"] for event in robot.of("rejected")] == [
        "the position of this agent is simulated; start it with --sensor stdin to measure it"
    ]
    assert not robot.of("command")


def test_word_of_a_body_is_of_the_version_and_the_size_that_both_know() -> None:
    """Version 1 told of no bodies. A message is as long as it must be, and its numbers are finite."""
    station = rehearse(NodeSettings("admm")).runners["a2"].station
    assert station.core.width == station.core.core.width + 4
    assert np.isfinite(station.core.largest[-4:]).all()
    assert parts()["a2"].team.dimension == 2


# -- orders --------------------------------------------------------------------------------------------------------------------------------


def say_in_turn(robot: Robot, lines: list[Any]) -> None:
    """One line after the other, each when there was an answer to the one before; the last ends the agent."""
    left = iter([*lines, {"command": "stop"}])

    def script(robot: Robot) -> None:
        if robot.told[-1]["event"] in ("start", "changed", "rejected", "clock"):
            robot.say(next(left))

    robot.script = script


def test_orders_are_answered_one_by_one(robot: Robot) -> None:
    say_in_turn(robot, [
        {"command": "change", "constraint": "within", "center": [1, 0], "radius": 2},
        {"command": "change", "constraint": "within", "center": [1]},
        {"command": "change", "constraint": "within", "center": {"times": [0, 1], "values": [[0, 0], [1, 1]]}},
        {"command": "clock", "epoch": 1e9},
        {"command": "change", "constraint": "within", "center": {"times": [0, 1], "values": [[0, 0], [7, 7]]}},
        {"command": "join"},
        {"command": "reload"},
    ])  # fmt: skip
    run(sensor="simulated", attached=True)
    assert [event["parameters"] for event in robot.of("changed")] == [
        {"center": [1, 0], "radius": 2}, {"center": {"times": [0, 1], "values": [[0, 0], [7, 7]]}},
    ]  # fmt: skip
    assert [event["why"] for event in robot.of("rejected")] == [
        "agent 'solo', constraint 'within': center has 1 entry, but must have 2, one for each dimension of the team",
        "agent 'solo', constraint 'within': it moves with time, but nobody has said when t = 0 is; start the agent with --epoch",
        "the agent is in the team already",
        "the agent was started from a scenario; only a part of its own can be read again",
    ]


def test_a_part_that_was_written_anew_is_read_and_gone_on_with(robot: Robot) -> None:
    """From where the agent is, without a stop; one of another agent is refused."""
    part = split(SOLO, run="solo")["solo"]
    moved = replace(part, generation=1, team=split(loads(SOLO.text.replace("[0, 0]", "[9, 1]")), run="solo")["solo"].team)
    parts = iter([replace(part, me="other"), moved])

    def script(robot: Robot) -> None:
        now = robot.told[-1]
        if now["event"] in ("start", "rejected") and len(robot.of("start")) < 2:
            robot.say({"command": "reload"})
        elif now["event"] == "report" and len(robot.of("start")) == 2 and now["margin"] is not None and now["margin"] > 0:
            robot.say({"command": "stop"})

    robot.script = script
    run(lambda: next(parts), sensor="simulated", attached=True, speed=5.0)
    assert [event["why"] for event in robot.of("rejected")] == ["agent is 'other', but must stay 'solo'"]
    assert len(robot.of("start")) == 2
    assert [event["why"] for event in robot.of("end")] == ["told to stop"]
    np.testing.assert_allclose(robot.of("report")[-1]["position"], [9, 1], atol=1.0)


def test_one_on_standby_joins_when_told(robot: Robot) -> None:
    lines = iter([{"command": "change", "constraint": "within", "radius": 2}, {"command": "join"}, {"command": "stop"}])

    def script(robot: Robot) -> None:
        if robot.told[-1]["event"] in ("standby", "rejected", "start"):
            robot.say(next(lines))

    robot.script = script
    run(sensor="simulated", standby=True)
    assert [event["event"] for event in robot.told if event["event"] in ("standby", "rejected", "start", "end")] == [
        "standby", "rejected", "start", "end",
    ]  # fmt: skip


def test_constraints_that_move_need_somebody_to_say_when() -> None:
    moving = loads(SOLO.text.replace("[0, 0]", "{times: [0, 1], values: [[0, 0], [1, 1]]}"))
    with pytest.raises(InvalidSettings, match="nobody says when t = 0 is; say --epoch"):
        run_agent(split(moving)["solo"], NodeSettings("admm"), ProcessOptions())
