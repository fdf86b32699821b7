"""One private file an agent: what is in it, what is not, and what is said of a bad one."""

from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from consat.cli.commands import cli
from consat.errors import InvalidScenario, InvalidSettings, InvalidTeam
from consat.network.node.part import Part, read_part, split, write_part
from consat.network.node.problem import OwnSolver, ends
from consat.numerics import float64
from consat.problem.agent import Agent
from consat.problem.team import Team
from consat.scenario import Scenario, load, loads
from consat.scenario.files import Settings
from tests.networked.case_c import parts

SPLIT = """
consat: 1
agents:
  - {id: a1, constraints: [{kind: within, center: [2, 0], radius: 1, name: secret-goal}]}
  - {id: a2, constraints: [{kind: near, agent: a1, radius: 1.7, weight: 3}, {kind: expr, psi: "1 - norm2(a2 - a3)", name: tether}]}
  - {id: a3, constraints: [{kind: outside, center: [-7.25, 0], radius: 1}]}
communication: {graph: line}
"""


@pytest.mark.parametrize("estimates", ["local", "full"])
@pytest.mark.parametrize("name", ["case-a", "case-c", "example-1"])
def test_what_is_written_is_read_back(name: str, estimates: str) -> None:
    for agent, part in split(load(name, [f"protocol.estimates={estimates}"])).items():
        text = write_part(part)
        again = read_part(text, "part.yaml")
        assert write_part(again) == text
        assert again.problem("admm") == part.problem("admm")
        np.testing.assert_array_equal(again.first, part.first)
        assert again.me == agent


def test_a_part_tells_nothing_of_what_others_want() -> None:
    texts = {agent: write_part(part) for agent, part in split(loads(SPLIT)).items()}
    assert "secret-goal" in texts["a1"]
    assert "tether" in texts["a2"]
    assert "-7.25" in texts["a3"]
    assert "secret-goal" not in texts["a2"] + texts["a3"]
    assert "tether" not in texts["a1"] + texts["a3"]
    assert "-7.25" not in texts["a1"] + texts["a2"]
    assert "id: a3" not in texts["a1"]  # not even who else there is
    assert "17449" not in write_part(split(loads(SPLIT), port=17447)["a1"])  # nor where


def test_a_part_has_no_shares_in_others_starts() -> None:
    """It draws first estimates of the positions that it holds, but knows nobody's start but its own."""
    first = parts()
    own = {agent: part.first[part.team.ids.index(agent)] for agent, part in first.items()}
    for other in ("a1", "a3"):
        held = first["a2"].first[first["a2"].team.ids.index(other)]
        assert np.abs(held - own[other]).max() > 0.1


def test_the_hash_of_the_problem_is_of_common_knowledge_alone() -> None:
    """All agents of a run have the same; another goal of another agent changes nothing, another smoothing does."""
    one = {agent: part.problem("admm") for agent, part in split(loads(SPLIT), run="r").items()}
    other = split(loads(SPLIT.replace("radius: 1, name", "radius: 1.0001, name") + "smoothing: {nu_alpha: 5, nu_beta: 5}\n"), run="r")
    assert len(set(one.values())) == 1
    assert other["a1"].problem("admm") != one["a1"]
    assert other["a1"].problem("link") != other["a1"].problem("admm")


@float64
def test_the_ends_of_a_link_know_each_others_degrees() -> None:
    """Metropolis weights are symmetric, although each end computes its own."""
    made = split(load("example-1", ["protocol.estimates=full"]))
    weights = {}
    for agent, part in made.items():
        for (neighbour, of), weight in zip(ends(part), np.asarray(OwnSolver.of(part).links.metropolis), strict=True):
            weights[agent, neighbour, of] = weight
    assert weights
    assert all(weights[other, agent, of] == weight for (agent, other, of), weight in weights.items())


def test_without_the_others_a_part_is_that_of_a_smaller_team() -> None:
    left = parts()["a2"].without({"a3"})
    assert left.team.ids == ("a1", "a2")
    assert list(left.team.names) == ["near(a1)"]
    assert [neighbour.id for neighbour in left.neighbours] == ["a1"]
    assert left.without(set()) is left


def part_text() -> str:
    return write_part(parts()["a2"])


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("hops: 2", "hops: -2", "hops: it is -2, but must be greater than or equal to 0"),
        ("consat-part: 2", "consat-part: 1", "the version is 1, but this consat reads 2; split the scenario again"),
        ("psi: 1", "psi: -1", "psi: it is -1, but must be greater than 0"),
        ("travels: [a1]", "travels: [a3]", "it must name agents of shares, each once, in their order"),
        ("agent: a2\n", "agent: a9\n", "agent 'a9' is not among the agents of the scenario within"),
        ("length: 1", "length: .nan", "length: it is nan, but must be a finite number"),
        ("degrees: [1]", "degrees: [1, 1]", "it has 2 numbers, but must have one for each of shares"),
        ("shares: [a3]", "shares: [a7]", "'a7' is not among the agents of the scenario within"),
        ("radius: 0.7", "radius: -0.7", "agent 'a2', constraint 'near(a3)': radius is -0.7, but must be a positive number"),
        ("- {id: a1}", "- {id: a1, constraints: [{kind: within, center: [0, 0], radius: 1}]}", "a part holds only its agent's own"),
        ("nu_beta: 5", "nu_beta: {from: 1, to: 5, rate: 1}", "smoothing must give nu_alpha and nu_beta as numbers"),
        ("listen: ", "listens: ", "there is no key 'listens' in a part"),
        ("kind: near", "kind: !!python/object:os.system near", "tags (!) are not part of a scenario"),
        ("tcp/127.0.0.1:7447", "tcp/127.0.0.1", "but String must match pattern"),
        ("convex: true", "convex: perhaps", "convex: it is 'perhaps', but must be a valid boolean"),
    ],
)
def test_a_bad_part_is_told_by_line_and_column(old: str, new: str, message: str) -> None:
    text = part_text()
    if old not in text:
        text = write_part(split(load("case-c"))["a2"])
    assert old in text
    with pytest.raises(InvalidScenario) as caught:
        read_part(text.replace(old, new, 1), "part.yaml")
    assert message in str(caught.value)
    assert all(line.startswith("part.yaml:") for line in str(caught.value).splitlines())


@pytest.mark.parametrize("text", ["", "[1, 2]", "consat: 1", "consat-part: 2\nscenario: 3", "\x00"])
def test_what_is_no_part_is_refused(text: str) -> None:
    with pytest.raises(InvalidScenario):
        read_part(text, "part.yaml")


def test_no_file_can_hold_a_python_function() -> None:
    import consat as cs

    team = Team([Agent("a1", [cs.constraint(lambda a1: 1.0 - a1 @ a1, reads=("a1",))])])
    scenario = Scenario("team", team, Settings(), "", "team")
    with pytest.raises(InvalidTeam, match="Python function"):
        write_part(split(scenario)["a1"])


@pytest.mark.parametrize("options", [{"absent": ["b"]}, {"addresses": {"b": "tcp/127.0.0.1:1"}}, {"only": "b"}, {"port": 65535}])
def test_a_split_names_agents_that_exist(options: dict[str, object]) -> None:
    with pytest.raises(InvalidSettings):
        split(load("case-c"), **options)  # type: ignore[arg-type]


def test_split_writes_files_for_their_owners_alone(tmp_path: Path) -> None:
    done = CliRunner().invoke(cli, ["split", "case-c", "--out", str(tmp_path), "--address", "a2=tcp/192.168.0.7:9"], standalone_mode=False)
    assert done.exception is None, done.output
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a1.yaml", "a2.yaml", "a3.yaml"]
    assert all(path.stat().st_mode & 0o077 == 0 for path in tmp_path.iterdir())
    made: Part = read_part((tmp_path / "a1.yaml").read_text(), "a1.yaml")
    assert made.neighbours[0].address == "tcp/192.168.0.7:9"


def test_a_part_is_for_its_own_agent(tmp_path: Path) -> None:
    (tmp_path / "a2.yaml").write_text(part_text())
    done = CliRunner().invoke(cli, ["agent", str(tmp_path / "a2.yaml"), "--id", "a1"], standalone_mode=False)
    assert isinstance(done.exception, InvalidSettings)
    assert "is the part of agent 'a2', not of 'a1'" in str(done.exception)
