"""Files of timed commands: what is read, and what is refused before anything starts."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from consat.errors import InvalidScenario
from consat.network.deploy.commands import read_commands
from consat.network.deploy.observer import Observer
from consat.numerics import float64
from consat.problem.objective import Nu
from consat.runs.preparation import copies_of
from consat.scenario import load, loads
from consat.settings import ProtocolSettings

CONSAT = [sys.executable, "-c", "from consat.cli import main; main()"]
TEAM = load("case-c").team

YAML = """\
- {at: 5, command: disconnect, agents: [a2, a1]}
- {at: 1.5, agent: a1, command: change, constraint: goal, center: [1, 0], radius: 2}
- {at: 2, agent: a3, command: join}
- at: 4
  command: connect
  agents: [a1, a3]
- {at: 6, agent: a1, command: leave}
"""


def test_commands_are_in_the_order_of_their_times_and_known_beforehand() -> None:
    script = read_commands(YAML, "c.yaml", TEAM, "admm")
    assert [(each.at, each.command, each.agents) for each in script.commands] == [
        (1.5, "change", ("a1",)), (2, "join", ("a3",)), (4, "connect", ("a1", "a3")), (5, "disconnect", ("a2", "a1")),
        (6, "leave", ("a1",)),
    ]  # fmt: skip
    assert [sorted(stage.present) for stage in script.stages] == [["a1", "a2"]] * 2 + [["a1", "a2", "a3"]] * 3 + [["a2", "a3"]]
    assert [stage.team.linked for stage in script.stages][2:5] == [
        [("a1", "a2"), ("a2", "a3")], [("a1", "a2"), ("a1", "a3"), ("a2", "a3")], [("a1", "a3"), ("a2", "a3")],
    ]  # fmt: skip
    centers = [stage.team.families[0].parameters["center"][0].tolist() for stage in script.stages[:2]]
    assert (centers, TEAM.families[0].parameters["center"][0].tolist()) == ([[2, 0], [1, 0]], [2, 0])


def test_lines_of_json_say_the_same() -> None:
    lines = '\n{"at": 1.5, "agent": "a1", "command": "change", "constraint": "goal", "center": [1, 0], "radius": 2}\n'
    (command,) = read_commands(lines, "c.jsonl", TEAM, "admm").commands
    assert (command.constraint, command.parameters) == ("goal", {"center": [1, 0], "radius": 2})


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("- {at: 1, agent: a1, command: chnge}", "c:1:31: command 1: the command is 'chnge'; did you mean 'change'?"),
        ("- {at: -1, agent: a1, command: leave}", "c:1:8: command 1: at is -1, but must be a time from 0, s"),
        ("- {at: .nan, agent: a1, command: leave}", "c:1:8: command 1: at is nan"),
        ("- {at: 9, agent: a1, command: leave}", "c:1:8: command 1: at is 9 s, but the launch ends after 8 s"),
        ("\n- {at: 1, agent: a9, command: leave}", "c:2:18: command 1: there is no agent 'a9'"),
        ("- {at: 1, agent: [a1], command: leave}", "there is no agent ['a1']"),
        ("- {at: 1, command: leave}", "c:1:3: command 1: leave lacks agent"),
        ("- {at: 1, agent: a1, command: leave, when: 2}", "c:1:38: command 1: leave has no key 'when'"),
        ("- {at: 1, agent: a1, command: change, constraint: goal}", "change names no parameter"),
        ("- {at: 1, agent: a1, command: change, constraint: goal, radius: 0}", "c:1:65: agent 'a1', constraint 'goal': radius is 0"),
        ("- {at: 1, agent: a1, command: change, constraint: gaol, radius: 1}", "did you mean 'goal'?"),
        ("- {at: 1, agents: [a1], command: connect}", "agents is ['a1'], but must be two agents"),
        ("- {at: 1, agents: [a1, a2], command: connect}", "c:1:19: link [a1, a2]: they are linked already"),
        ("- {at: 1, agents: [a1, a3], command: disconnect}", "there is no such link"),
        ("- {at: 1, agents: [a1, a2], command: disconnect}", "c:1:19: without the link [a1, a2]: the constraints tie"),
        ("- {at: 1, agent: a1, command: leave}\n- {at: 2, agent: a1, command: leave}", "c:2:18: agent 'a1': it is not there at 2 s"),
        ("- {at: 1, agent: a1, command: leave}\n- {at: 2, agent: a1, command: change, constraint: goal, radius: 1}", "not there at 2 s"),
        ('{"at": 1, "agent": "a1", "command": "leave"}\n{"at": 2, "agent": "a1", "command": "leave"}', "c:2:20: agent 'a1'"),
        ('{"at": 1, "agent": "a1"\n', "c:1:1: YAML"),
        ("- 3", "it is 3, but must be a mapping"),
        ("at: 3", "it must be a list of commands"),
        ("\n".join(f"- {{at: {k}, agent: a{k}, command: leave}}" for k in (1, 2, 3)), "it is the last agent"),
    ],
)  # fmt: skip
def test_faults_are_told_by_line_and_column(text: str, message: str) -> None:
    with pytest.raises(InvalidScenario) as caught:
        read_commands(text, "c", TEAM, "interior-point", 8.0)
    assert message in str(caught.value)


def test_lockstep_takes_no_changes() -> None:
    with pytest.raises(InvalidScenario, match="mode lockstep goes as consat run does"):
        read_commands("- {at: 1, agent: a1, command: change, constraint: goal, radius: 2}", "c", TEAM, "lockstep")


def test_a_launch_with_a_fault_starts_nothing(tmp_path: Path) -> None:
    file = tmp_path / "c.jsonl"
    file.write_text(json.dumps({"at": 1, "agent": "a1", "command": "change", "constraint": "goal", "center": [1]}))
    done = subprocess.run([*CONSAT, "launch", "case-c", "--commands", str(file)], capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 3
    assert done.stderr.startswith(f"{file}:1:79: agent 'a1', constraint 'goal': center has 1 entry, but must have 2")
    assert not done.stdout


MOVING = """
consat: 1
agents:
  - {id: a, start: [0, 0], constraints: [{kind: within, center: {times: [0, 2], values: [[0, 0], [2, 0]]}, radius: 1, name: goal}]}
  - {id: b, start: [0, 0], constraints: [{kind: near, agent: a, radius: 2}]}
"""


@float64
def test_an_observer_judges_each_moment_by_the_constraints_of_that_moment() -> None:
    """Both stand at the origin while the goal goes away, then comes back at once by a change, after which b leaves."""
    team = loads(MOVING).team
    text = "- {at: 1.5, agent: a, command: change, constraint: goal, center: [0, 0]}\n- {at: 2, agent: b, command: leave}"
    stages = read_commands(text, "c", team, "admm").stages
    observer = Observer(team, np.zeros((2, 2)), "time")
    observer.origin = 100.0
    for agent in team.ids:
        track = [[100.0 + 0.1 * k, 0.0, 0.0] for k in range(31)]
        observer.take([{"event": "report", "id": agent, "t": 0.0, "track": track, "sent": {}, "peers": {}}])
    observer.present = stages[-1].present
    trace = observer.trace(copies_of(stages[-1].present_team()[0], ProtocolSettings()), Nu(5.0, 5.0), "out of time", {}, stages, 1.0)
    early, late = trace.steps < 1.5 - 1e-6, trace.steps > 1.5 + 1e-6
    np.testing.assert_allclose(trace.agent_margin[early, 0], 1 - trace.steps[early] ** 2, atol=1e-9)
    np.testing.assert_allclose(trace.agent_margin[late, 0], 1.0)
    assert (trace.position.shape[1:], trace.steps[-1]) == ((1, 2), pytest.approx(3.0))
    assert trace.motion is not None
    assert trace.motion["worst_margin_after"] == pytest.approx(trace.margin.min())
    assert trace.motion["satisfied_share"] == pytest.approx(np.mean(trace.margin > 0))
    assert 0.8 < trace.motion["satisfied_share"] < 0.85  # all but from 1 to 1.5 s, of 3 s
