"""Scenarios: files, packaged ones, overrides, and writing a team back."""

import re
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import minimize

import consat as cs
from consat.errors import InvalidScenario, InvalidTeam
from consat.numerics import float64
from consat.problem.graphs import clusters, disconnected, require_connected, task_edges
from consat.problem.objective import Objective
from consat.scenario import Scenario, dump, load, loads, located, packaged, packaged_text, template
from consat.scenario.document import read
from consat.scenario.writing import write
from consat.settings import ProtocolSettings, Ramp, Settings, Smoothing, Start

CASES = ("case-a", "case-b", "case-c", "case-d", "case-e")
SMALL = """\
consat: 1
agents:
  - id: a1
    constraints:
      - {kind: within, center: [0, 0], radius: 1, name: goal}
  - id: a2
    constraints:
      - {kind: near, agent: a1, radius: 2}
"""


@float64
def margins(team: cs.Team, x: np.ndarray) -> np.ndarray:
    return np.asarray(Objective.at_positions(team).psi(jnp.asarray(x)))


@float64
def best_margin(team: cs.Team) -> float:
    """The largest smallest ψ, by smoothing it ever less; crude, from one start."""
    objective = Objective.at_positions(team)
    shape = team.count, team.dimension

    def smooth(z: jax.Array, nu: jax.Array) -> jax.Array:
        return jax.nn.logsumexp(-nu * objective.psi(z.reshape(shape))) / nu

    gradient = jax.jit(jax.value_and_grad(smooth))
    z = np.random.default_rng(0).uniform(-4, 4, team.count * team.dimension)
    for nu in (0.1, 1.0, 5.0, 30.0, 200.0):
        z = minimize(lambda z, nu: [np.asarray(part) for part in gradient(z, nu)], z, args=(nu,), jac=True).x
    return float(margins(team, z.reshape(shape)).min())


# The packaged scenarios.

DRIVEN = ("corridor", "drones", "escort", "swap", "warehouse")
"""Those of robots."""


def test_packaged_names() -> None:
    assert packaged() == tuple(sorted((*CASES, *DRIVEN, "convoy", "example-1", "lattice", "swarm")))


@pytest.mark.parametrize("name", packaged())
def test_packaged_scenario_says_what_it_shows(name: str) -> None:
    lines = packaged_text(name).splitlines()
    comment = next(number for number, line in enumerate(lines) if not line.startswith("# "))
    assert 2 <= comment <= 4
    scenario = load(name)
    assert (scenario.name, scenario.source, scenario.text) == (name, name, packaged_text(name))
    assert scenario.team.dimension == (3 if name == "drones" else 2)
    assert not disconnected(scenario.team)
    assert (scenario.robots is not None) == (name in DRIVEN)
    assert name in DRIVEN or np.isnan(scenario.team.starts).all()
    assert scenario.settings.protocol == ProtocolSettings()


@pytest.mark.parametrize("name", CASES)
def test_cases_carry_the_settings_of_the_paper(name: str) -> None:
    scenario = load(name)
    ramp = Ramp(start=0.01, to=5, rate=0.022)
    assert scenario.settings == Settings(start=Start(box=(-4, 4)), smoothing=Smoothing(nu_alpha=5, nu_beta=ramp))
    assert scenario.team.links.tolist() == [[0, 1], [1, 2]]


@pytest.mark.parametrize(
    ("name", "at", "values"),  # ψ by hand, in the order of the paper, at positions where no two of them agree by accident
    [
        ("case-a", [[3, 1], [0, 2], [-1, 5]], [1 - 2, 1 - 10, 1 - 10]),
        ("case-b", [[3, 1], [0, 2], [-1, 5]], [1 - 2, 9 - 10, 4 - 10, 1 - 26]),
        ("case-c", [[3, 1], [0, 2], [-1, 5]], [1 - 2, 2.89 - 10, 0.49 - 10, 1 - 26]),
        ("case-d", [[3, 1], [0, 2], [-1, 5]], [1 - 2, 1.96 - 10, 0.16 - 10, 1 - 26]),
        ("case-e", [[3, 1], [0, 2], [-1, 5]], [1 - 2, 1 - 10, 10 - 0.04, 1 - 10, 1 - 32, 32 - 0.04, 10 - 0.04]),
    ],
)
def test_cases_are_those_of_the_paper(name: str, at: list[list[float]], values: list[float]) -> None:
    assert margins(load(name).team, np.array(at, dtype=float)) == pytest.approx(values, abs=1e-12)  # rounding


@pytest.mark.parametrize(
    ("name", "margin"),
    [("case-a", 1), ("case-b", 1), ("case-c", 0.18608), ("case-d", -0.08144), ("case-e", 0.48), ("example-1", 1)],
)
def test_best_margin(name: str, margin: float) -> None:
    assert best_margin(load(name).team) == pytest.approx(margin, abs=0.01)  # smoothing at ν = 200 costs up to ln(13)/200


def test_example_1_has_the_dependencies_of_the_paper() -> None:
    team = load("example-1").team
    assert [sorted({team.ids[j][1:] for i, j in task_edges(team) if i == owner and i != j}) for owner in range(7)] == [
        ["2"], ["1"], ["1"], ["1", "2", "3"], ["3", "4"], ["7"], [],
    ]  # fmt: skip
    assert team.constraints_per_agent.tolist() == [2, 2, 1, 2, 3, 2, 1]
    assert clusters(team).tolist() == [0, 0, 0, 0, 0, 1, 1]
    assert {(3, 0), (3, 1), (4, 2)}.isdisjoint({tuple(sorted(link, reverse=True)) for link in team.links.tolist()})
    assert [1, 2] in team.links.tolist()


def test_template_is_a_feasible_scenario_with_comments() -> None:
    assert template().count("#") > 10
    scenario = loads(template())
    assert best_margin(scenario.team) > 0
    assert not disconnected(scenario.team)


# Files and names.


def test_load_of_a_file(tmp_path: Path) -> None:
    file = tmp_path / "pair.yaml"
    file.write_text("\ufeff" + SMALL)
    for source in (file, str(file)):
        scenario = load(source)
        assert (scenario.name, scenario.source, scenario.text) == ("pair", str(file), SMALL)
    assert scenario.settings == Settings()
    assert scenario.team.links.tolist() == [[0, 1]]  # along the task graph


def test_a_path_that_exists_wins(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert load("case-a").team.count == 3
    Path("case-a").write_text(SMALL)
    assert load("case-a").team.count == 2


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("case-f", r"case-f: there is no such file or packaged scenario; consat init writes .*; did you mean 'case-e'\?"),
        ("nowhere/caseb.yaml", r"nowhere/caseb.yaml: there is no such file .*; did you mean 'case-b'\?"),
        ("zzz.yaml", "zzz.yaml: there is no such file or packaged scenario; consat init writes a scenario to begin with$"),
        (".", r"\.: this is a directory, but must be a scenario file"),
        ("a\0b", "a\0b: cannot be read: embedded null byte"),
        ("x" * 5000, "x+: cannot be read: File name too long"),
    ],
)
def test_missing_file(name: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(InvalidScenario, match=rf"\A{message}") as caught:
        load(name)
    assert "\n" not in str(caught.value)


def test_yaml_of_version_1_2() -> None:
    root = read("[0x1F, 0o17, 012, 1e3, -.INF, yes, True, ~, null, '5', 1., ., 12:30, 2020-01-01]", "f").root
    assert root is not None
    assert root.plain == [31, 15, 12, 1000.0, -np.inf, "yes", True, None, None, "5", 1.0, ".", "12:30", "2020-01-01"]


def test_key_without_a_value_is_not_given() -> None:
    assert loads(SMALL + "name:\ncommunication: ~\nstart:\nsmoothing: null\n", "pair").settings == Settings()


# Overrides.


@pytest.mark.parametrize(
    ("override", "path", "value"),
    [
        ("start.box=[-9,9]", "settings.start.box", (-9, 9)),
        ("start.seed= 7", "settings.start.seed", 7),
        ("smoothing=auto", "settings.smoothing", "auto"),
        ("smoothing.nu_beta=3", "settings.smoothing.nu_beta", 3),
        ("smoothing.nu_beta.rate=3", "settings.smoothing.nu_beta.rate", 3),
        ("protocol.kind=admm", "settings.protocol.kind", "admm"),
        ("name=", "name", "case-b"),
        ("name=a=b", "name", "a=b"),
        ("smoothing=", "settings.smoothing", "auto"),
        ("communication={graph: ring}", "team.links.shape", (3, 2)),
        ("agents.0.id=a1", "team.ids", ("a1", "a2", "a3")),
        ("agents.a2.constraints=[]", "team.names", ("goal", "goal")),
        ("agents.a1.start=[1,2]", "team.count", 3),
    ],
)
def test_override(override: str, path: str, value: object) -> None:
    scenario: object = load("case-b", [override])
    again: object = loads(scenario.text, "case-b") if isinstance(scenario, Scenario) else None  # what a result stores says it all
    for part in path.split("."):
        scenario, again = getattr(scenario, part), getattr(again, part)
    assert scenario == again == value


@pytest.mark.parametrize("agent", ["0", "a1"])
@pytest.mark.parametrize("constraint", ["0", "goal"])
def test_override_of_a_constraint(agent: str, constraint: str) -> None:
    scenario = load("case-a", [f"agents.{agent}.constraints.{constraint}.radius=2", "agents.a2.constraints.0.radius=3"])
    origin = margins(scenario.team, np.zeros((3, 2)))
    assert origin.tolist() == [0, 9, 1]
    assert margins(loads(scenario.text).team, np.zeros((3, 2))).tolist() == [0, 9, 1]
    assert scenario.text.startswith("# 'case-a' with --set 'agents.")


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("start", "path: this must be PATH=VALUE with a dotted path, such as"),
        ("=3", "path: this must be PATH=VALUE"),
        ("start..box=3", "path: this must be PATH=VALUE"),
        ("agents.a9.start=3", r"path: there is no entry 'a9' in agents, counted from 0 to 2"),
        ("agents.3.start=3", "path: there is no entry '3' in agents, counted from 0 to 2"),
        ("agents.-1.start=3", "path: there is no entry '-1' in agents"),
        ("name.x=3", "path: name is 'case-a', which has no entry 'x'"),
        ("start.box=[1", r"YAML: a comma between entries or the closing \] is missing"),
        ("start.seed=&a 3", "YAML: anchors"),
        ("protocol={k1: 1, k1: 2}", "YAML: the key 'k1' stands here for the second time"),
        ("start.seed=x", "start: seed is 'x', but must be a whole number"),
        ("start.box=[1, 0]", r"start: box is \[1.0, 0.0\], but must be"),
        ("start.bos=3", r"start: there is no key 'bos'; the keys are box, seed; did you mean 'box'\?"),
        ("far.away=3", "scenario: there is no key 'far'"),
        ("agents.a1.constraints.0.radius=-1", "agent 'a1', constraint 'goal': radius is -1, but must be a positive number"),
        ("agents.a1.constraints.0={kind: expr, psi: abs(a1.x)}", "agent 'a1', constraint 'expr': abs has no gradient"),
        ("agents.a1=5", r"agents\[0\]: it is 5, but must be a mapping"),
        ("consat=2", "consat: the scenario is of version 2"),
    ],
)
def test_fault_of_an_override_names_the_override(override: str, message: str) -> None:
    with pytest.raises(InvalidScenario) as caught:
        load("case-a", ["start.seed=3", override])
    first = str(caught.value).splitlines()[0]
    assert first.startswith(f"--set {override}: ")
    assert re.match(message, first.removeprefix(f"--set {override}: ")), first


def test_faults_of_overrides_come_with_those_of_the_file() -> None:
    with pytest.raises(InvalidScenario) as caught:
        loads(SMALL.replace("radius: 1", "radius: -1"), "s.yaml", ["start.seed=x", "agents.a2.constraints.0.radius=0", "oops"])
    assert [line.split(": ")[0] for line in str(caught.value).splitlines()] == [
        "--set agents.a2.constraints.0.radius=0",
        "--set oops",
        "--set start.seed=x",
        "s.yaml:5:48",
    ]


# Faults that show later.


def test_cluster_without_links_is_located() -> None:
    scenario = loads(SMALL + "communication: {links: []}\n", "s.yaml")
    with pytest.raises(InvalidTeam) as caught:
        require_connected(scenario.team)
    error = located(caught.value, scenario)
    assert isinstance(error, InvalidScenario)
    assert str(error).startswith("s.yaml:9:16: communication: the constraints tie {a1} and {a2} together")
    assert located(error, scenario) is error


def test_cluster_without_links_through_an_override() -> None:
    scenario = loads(SMALL, "s.yaml", ["communication.links=[]"])
    with pytest.raises(InvalidTeam) as caught:
        require_connected(scenario.team)
    assert str(located(caught.value, scenario)).startswith("--set communication.links=[]: communication: the constraints tie")


def test_team_that_was_never_in_a_file() -> None:
    team = cs.Team([cs.Agent("a", [cs.near("b", 1)]), cs.Agent("b")], links=[])
    with pytest.raises(InvalidTeam) as caught:
        require_connected(team)
    error = located(caught.value, Scenario("team", team, Settings(), "", "team"))
    assert isinstance(error, InvalidScenario)
    assert str(error) == str(caught.value)


# Writing.


def mixed() -> cs.Team:
    """Every kind of constraint, awkward ids, names and numbers."""
    return cs.Team(
        [
            cs.Agent("null", [cs.within([1, 2, 3], 0.1, name="true"), cs.outside([0.1, 1e-7, -3e20], 2, weight=1 / 3)], [1, 1e-300, 0]),
            cs.Agent('it\'s "a" é😀', [cs.near("null", 3), cs.near("null", 4), cs.near("null", 5, name="1e3"), cs.apart("7", 0.5)]),
            cs.Agent("7", [cs.displacement("no", [1, -1, 0], 2), cs.halfspace([0, 1, 2], -0.0), cs.expr("1 - norm2('7' - 'null') / 3")]),
            cs.Agent("no", [cs.box([0, -1, 1 / 3], [1, 2, 3], weight=2), cs.box([-9, -9, -9], [9, 9, 9], name="# far: {out}")]),
            cs.Agent("- idle"),
            cs.Agent("tab", [cs.expr("2 -\n\tnorm2(tab - no)"), cs.expr("4 - norm2(tab - no)", name="é: x")]),
        ],
        links=[("null", "no"), ("- idle", "7")],
        dimension=3,
    )


def same(one: cs.Team, other: cs.Team) -> bool:
    x = np.random.default_rng(1).normal(size=(one.count, one.dimension))
    return (
        (one.ids, one.names, one.dimension) == (other.ids, other.names, other.dimension)
        and np.array_equal(one.owner, other.owner)
        and np.array_equal(one.links, other.links)
        and np.array_equal(one.starts, other.starts, equal_nan=True)
        and bool(np.allclose(margins(one, x), margins(other, x), rtol=1e-12, atol=1e-12))  # a side of a box is summed in another order
    )


def test_dump_says_everything() -> None:
    settings = Settings(
        start=Start(box=((-4, -4, -4), (4, 4, 4.5)), seed=3),
        protocol=ProtocolSettings(kind="admm", k1=2),
        smoothing=Smoothing(nu_alpha=5, nu_beta=Ramp(start=0.01, to=5, rate=0.022)),
    )
    again = loads(dump(mixed(), settings, "a: b"), "team.yaml")
    assert same(again.team, mixed())
    assert (again.settings, again.name) == (settings, "a: b")


@pytest.mark.parametrize("name", packaged())
def test_dump_of_a_packaged_scenario(name: str) -> None:
    scenario = load(name)
    text = dump(scenario.team, scenario.settings, name, robots=scenario.robots, rate=scenario.rate)
    again = loads(text)
    assert same(again.team, scenario.team)
    assert again.settings == scenario.settings
    if scenario.robots is not None:
        assert again.robots is not None
        assert (again.robots.data, again.rate) == (scenario.robots.data, scenario.rate)
        return
    body = [line for line in packaged_text(name).splitlines() if not line.startswith("#")]
    end = next(number for number, line in enumerate(body) if line.startswith("communication"))
    assert text.splitlines()[:end] == body[:end]  # the agents are written as a person would


@pytest.mark.parametrize("graph", ["line", "ring", "star", "complete", "task"])
def test_dump_recognises_the_graph(graph: str) -> None:
    team = cs.Team([cs.Agent("a0"), *(cs.Agent(f"a{i}", [cs.near("a2" if i == 1 else "a1", 1)]) for i in range(1, 6))], links=graph)
    text = dump(team)
    assert f"communication: {{graph: {graph}}}" in text
    assert same(loads(text).team, team)


def test_dump_of_python_functions_names_them() -> None:
    def ring(a: jax.Array) -> jax.Array:
        return 1 - jnp.sum(a**2)

    agents = [cs.Agent("a", [cs.within([0, 0], 1), cs.constraint(ring, ["a"])]), cs.Agent("b", [cs.constraint(ring, ["b"], name="near")])]
    with pytest.raises(InvalidTeam) as caught:
        dump(cs.Team(agents))
    assert str(caught.value).splitlines() == [
        "agent 'a', constraint 'ring': it is a Python function, which no file can hold; use a library constraint or consat.expr",
        "agent 'b', constraint 'near': it is a Python function, which no file can hold; use a library constraint or consat.expr",
    ]
    assert [fault.path for fault in caught.value.faults] == [("agents", 0, "constraints", 1), ("agents", 1, "constraints", 0)]


TEXT = st.text(st.characters(exclude_categories=["Cs", "Cc"]) | st.sampled_from("\n\t\x85 #:'\"\\-[]{},"), max_size=12)
NUMBER = st.integers(-(10**20), 10**20) | st.floats(allow_nan=False, allow_infinity=False)
TREE = st.recursive(
    st.none() | st.booleans() | NUMBER | TEXT | st.sampled_from(["null", "~", "1e3", "0x1", "yes", "true", "<<", "12:30", ""]),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(TEXT, inner, max_size=4),
    max_leaves=20,
)


@given(st.dictionaries(TEXT, TREE, max_size=4))
def test_what_is_written_is_read(data: dict[str, object]) -> None:
    root = read(write(data), "f").root
    assert (root.plain if root else None) == (data or None)


# Speed, in CPU time; the limits allow for a machine several times slower than ours.


def test_small_scenario_loads_quickly() -> None:
    load("case-a")  # what is imported and traced once
    begin = time.process_time()
    for _ in range(5):
        load("case-a")
    assert (time.process_time() - begin) / 5 < 0.05  # 5 ms


def test_a_thousand_agents_load_quickly() -> None:
    agents = [cs.Agent(f"a{i}", [cs.within([i, 0], 1), cs.near(f"a{(i + 1) % 1000}", 3)], start=[i, 0]) for i in range(1000)]
    text = dump(cs.Team(agents))
    begin = time.process_time()
    assert loads(text).team.count == 1000
    assert time.process_time() - begin < 4  # 0.8 s, nearly all of it in the YAML parser
