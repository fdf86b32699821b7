"""A team that is stepped, and changed between two rounds."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

import consat as cs


def trio(**more: Any) -> cs.Team:
    return cs.Team(
        [
            cs.Agent("a1", [cs.within([2, 0], 1, name="goal")], start=[3, 1]),
            cs.Agent("a2", [cs.near("a1", 3), cs.near("a3", 2)], start=[0, 2]),
            cs.Agent("a3", [cs.within([-2, 0], 1, name="goal")], start=[-3, -1]),
        ],
        links=[("a1", "a2"), ("a2", "a3")],
        **more,
    )


@pytest.fixture(scope="module")
def settled() -> cs.Session:
    return cs.Session(trio()).step(30)


def state_of(session: cs.Session) -> tuple[str, list[Any], int, float]:
    return cs.dump(session.team), session.positions.tolist(), session.round, session.margin


def test_rounds_are_those_of_a_run(settled: cs.Session) -> None:
    run = cs.run(trio(), rounds=30)
    np.testing.assert_array_equal(settled.positions, run.data["position"].values[-1])
    np.testing.assert_allclose(settled.margins, [run.summary["agents"][agent]["margin"] for agent in ("a1", "a2", "a3")], atol=1e-12)
    assert settled.satisfied
    assert settled.known == "satisfied"
    assert (settled.round, settled.time) == (30, 1.5)


def test_parameters_compile_nothing_and_the_team_follows() -> None:
    session = cs.Session(trio()).step(20)
    session.change("a1", "goal", center=[2.01, 0]).step(10)
    with_listener: list[str] = []

    def listen(event: str, *_: Any, **__: Any) -> None:
        if event.startswith("/jax/core/compile/backend_compile"):
            with_listener.append(event)

    import jax

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        for k in range(5):
            session.change("a1", "goal", center=[2.2, 0.1 * k]).step(10)
            assert session.satisfied
        session.change("a1", "goal", radius=0.5).change("a2", "near(a1)", radius=2.5).step(20)
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)
    assert with_listener == []
    fresh = cs.Session(session.team).step(60)
    assert session.margin == pytest.approx(fresh.margin, abs=0.02)
    np.testing.assert_allclose(session.margins, cs.margins(session.team, session.positions), atol=1e-12)


def test_an_impossible_goal_is_proven_so_by_the_team_and_forgotten_when_it_is_possible_again() -> None:
    session = cs.Session(trio()).step(20)
    session.change("a1", "goal", center=[9, 0]).step(60)
    assert session.known == "infeasible"
    told = session.assess()
    assert told.verdict == "infeasible"
    assert told.bounds[1] is not None
    assert told.bounds[1] < 0
    assert any("goal" in reason for reason in told.reasons)
    assert session.margin <= told.bounds[1] + 1e-9
    session.change("a1", "goal", center=[2, 0])
    for _ in range(80):  # never a proof of what is no more
        session.step()
        assert session.known != "infeasible"
    assert session.satisfied
    assert session.assess().verdict == "feasible"


def test_members_and_links_come_and_go_and_the_others_go_on() -> None:
    session = cs.Session(trio()).step(20)
    before = session.positions
    session.add(cs.Agent("a4", [cs.near("a3", 1), cs.within([-2, 1], 1, name="post")]), links=["a3"])
    np.testing.assert_array_equal(session.positions[:3], before)
    margin = session.margins[:3].min()
    session.step(3)
    assert session.margins[:3].min() > 0.5 * margin  # they did not begin again
    session.step(20)
    assert session.satisfied
    assert list(session.team.ids) == ["a1", "a2", "a3", "a4"]
    session.connect("a4", "a2").step(5).disconnect("a4", "a3").step(20)
    assert session.satisfied
    session.add_constraint("a4", cs.within([-1.5, 0.5], 1, name="second")).step(20)
    assert session.satisfied
    assert len(session.team.agents[3].constraints) == 3
    session.remove_constraint("a4", "second").remove("a4").step(10)
    assert cs.dump(session.team) == cs.dump(cs.Session(trio()).team)
    assert session.satisfied
    result = session.result()
    assert result.summary["status"] == "satisfied"
    assert result.data["position"].shape == (session.round + 1, 3, 2)
    assert result.data["margin"].shape == (session.round + 1,)


def test_without_the_middle_nobody_can_talk() -> None:
    team = cs.Team(
        [cs.Agent(f"b{k}", [cs.near(f"b{k - 1}", 2)] if k else [cs.within([0, 0], 1)], start=[k, 0]) for k in range(4)], links="line"
    )
    session = cs.Session(team).step(5)
    session.remove("b1").step(20)  # and with it b2's constraint, which read it
    assert session.satisfied
    assert list(session.team.ids) == ["b0", "b2", "b3"]
    held = state_of(session)
    with pytest.raises(cs.InvalidTeam, match=r"without the link \[b2, b3\].*add a link such as"):
        session.disconnect("b2", "b3")
    assert state_of(session) == held


def wrong_changes() -> list[Callable[[cs.Session], Any]]:
    return [
        lambda s: s.change("a9", "goal", center=[0, 0]),
        lambda s: s.change("a1", "gaol", center=[0, 0]),
        lambda s: s.change("a1", "goal", center=[0, 0, 0]),
        lambda s: s.change("a1", "goal", center=[0, float("nan")]),
        lambda s: s.change("a1", "goal", center="here"),
        lambda s: s.change("a1", "goal", radius=-1),
        lambda s: s.change("a1", "goal", radius=True),
        lambda s: s.change("a1", "goal", center=[1, 1], radius=0),
        lambda s: s.change("a1", "goal", vector=[1, 1]),
        lambda s: s.change("a1", "goal", weight=-2),
        lambda s: s.change("a1", "goal", center={"times": [1, 0], "values": [[0, 0], [1, 1]]}),
        lambda s: s.place("a1", [1]),
        lambda s: s.place("nobody", [1, 1]),
        lambda s: s.add("a4"),
        lambda s: s.add(cs.Agent("a1", [cs.within([0, 0], 1)])),
        lambda s: s.add(cs.Agent("a4", [cs.near("a7", 1)])),
        lambda s: s.add(cs.Agent("a4", [cs.near("a1", 1)]), links=["a8"]),
        lambda s: s.add(cs.Agent("a4", [cs.near("a1", 1)]), links=[]),
        lambda s: s.remove("a8"),
        lambda s: s.connect("a1", "a2"),
        lambda s: s.connect("a1", "a1"),
        lambda s: s.disconnect("a1", "a3"),
        lambda s: s.disconnect("a1", "a2"),
        lambda s: s.add_constraint("a1", "within"),
        lambda s: s.add_constraint("a1", cs.within([0, 0], 1, name="goal")),
        lambda s: s.remove_constraint("a1", "near(a2)"),
    ]


@pytest.mark.parametrize("change", wrong_changes())
def test_a_refused_change_leaves_the_session_as_it_was(settled: cs.Session, change: Callable[[cs.Session], Any]) -> None:
    before = state_of(settled)
    with pytest.raises(cs.ConsatError) as refused:
        change(settled)
    assert str(refused.value)
    assert "\n" not in str(refused.value)
    assert state_of(settled) == before


HOME = cs.within([0, 0], 6, name="home")
FOURTH = cs.Agent("a4", [cs.near("a3", 2)], start=[-2, 2])


class Changes(RuleBasedStateMachine):
    """Good and bad changes in any order, beside a plain description of what the team should have become."""

    def __init__(self) -> None:
        super().__init__()
        self.session = cs.Session(trio()).step(20)
        self.goals: dict[str, tuple[list[float], float]] = {"a1": ([2.0, 0.0], 1.0), "a3": ([-2.0, 0.0], 1.0)}
        self.joined = self.home = False

    def expected(self) -> cs.Team:
        agents = [
            cs.Agent("a1", [cs.within(*self.goals["a1"], name="goal")], start=[3, 1]),
            cs.Agent("a2", [cs.near("a1", 3), cs.near("a3", 2), *([HOME] if self.home else [])], start=[0, 2]),
            cs.Agent("a3", [cs.within(*self.goals["a3"], name="goal")], start=[-3, -1]),
            *([FOURTH] if self.joined else []),
        ]
        links = [("a1", "a2"), ("a2", "a3"), *([("a2", "a4"), ("a3", "a4")] if self.joined else [])]
        return cs.Team(agents, links=links)

    @rule(rounds=st.integers(0, 3))
    def step(self, rounds: int) -> None:
        self.session.step(rounds)

    @rule(agent=st.sampled_from(["a1", "a3"]), away=st.tuples(*[st.floats(-0.4, 0.4)] * 2), radius=st.floats(0.8, 1.2))
    def move_a_goal(self, agent: str, away: tuple[float, float], radius: float) -> None:
        center = [(2.0 if agent == "a1" else -2.0) + away[0], away[1]]
        self.goals[agent] = (center, radius)
        self.session.change(agent, "goal", center=center, radius=radius)

    @rule(agent=st.sampled_from(["a1", "a2", "a3"]), where=st.tuples(*[st.floats(-4, 4)] * 2))
    def push(self, agent: str, where: tuple[float, float]) -> None:
        self.session.place(agent, where)
        assert self.session.positions[self.session.team.ids.index(agent)].tolist() == list(where)

    @rule(change=st.sampled_from(wrong_changes()))
    def be_refused(self, change: Callable[[cs.Session], Any]) -> None:
        before = state_of(self.session)
        with pytest.raises(cs.ConsatError):
            change(self.session)
        assert state_of(self.session) == before

    @precondition(lambda self: not self.joined and not self.home)  # fewer structures to compile
    @rule()
    def join(self) -> None:
        self.session.add(FOURTH, links=["a2", "a3"])
        self.joined = True

    @precondition(lambda self: self.joined)
    @rule()
    def leave(self) -> None:
        self.session.remove("a4")
        self.joined = False

    @precondition(lambda self: not self.home and not self.joined)
    @rule()
    def gain_a_constraint(self) -> None:
        self.session.add_constraint("a2", HOME)
        self.home = True

    @precondition(lambda self: self.home)
    @rule()
    def lose_a_constraint(self) -> None:
        self.session.remove_constraint("a2", "home")
        self.home = False

    @invariant()
    def is_the_expected_team(self) -> None:
        assert cs.dump(self.session.team) == cs.dump(self.expected())
        np.testing.assert_allclose(self.session.margins, cs.margins(self.session.team, self.session.positions), atol=1e-12)

    def teardown(self) -> None:
        self.session.step(60)
        fresh = cs.Session(self.expected()).step(80)
        assert self.session.satisfied == fresh.satisfied
        # of ψ about 1; once it is satisfied a team climbs on slowly, from where it was: 0.96 where a fresh one has 1.00
        assert self.session.margin == pytest.approx(fresh.margin, abs=0.06)


TestChanges = Changes.TestCase
TestChanges.settings = settings(max_examples=6, stateful_step_count=60, deadline=None, derandomize=True)


def test_schedules_and_the_time_are_followed_and_can_begin_in_a_session() -> None:
    session = cs.Session(trio(), rate=10).step(20)
    path = cs.schedule([2.0, 4.0], [[2.0, 0.0], [2.0, 0.8]])
    session.change("a1", "goal", center=path)
    assert session.team.moves
    for _ in range(30):
        session.step()
        assert session.satisfied
        here = session.team.at(session.time)
        np.testing.assert_allclose(session.margins, cs.margins(here, session.positions), atol=1e-12)
    assert session.team.at(session.time).families[0].parameters["center"][0].tolist() == [2.0, 0.8]
    session.change("a1", "goal", center=[2.0, 0.0]).step(10)
    assert not session.team.moves
    assert session.satisfied


def test_nothing_is_claimed_of_constraints_that_were_not_in_force() -> None:
    path = cs.schedule([0.0, 10.0], [[-2.0, 0.0], [-2.5, 0.0]])
    session = cs.Session(trio(), rate=10)
    session.change("a3", "goal", center=path).step(20)
    assert session.known == "satisfied"
    session.change("a1", "goal", center=[40.0, 0.0])
    assert session.known is None, "nobody knows anything of the goal that has just moved"
    assert session.margin < 0
    result = session.step(20).result()
    [only] = result.summary["verdicts"]
    assert (only["from"], only["to"], only["verdict"]) == (2.0, 4.0, "infeasible")
    assert f"{session.assess().bounds[1]:.4g}".replace("-", "−") in str(result).split("in the way")[1].split("Raising")[0], "the end's"


def test_own_constraints_change_too() -> None:
    def disc(x: Any, *, at: Any, scale: Any) -> Any:
        return 1.0 - scale * jnp.sum((x - at) ** 2)

    own = cs.constraint(disc, reads=("a",), name="own", at=[1.0, 0.0], scale=1.0)
    session = cs.Session(cs.Team([cs.Agent("a", [own], start=[5, 5])])).step(30)
    assert session.satisfied
    session.change("a", "own", at=[3.0, 0.0]).step(20)
    assert session.satisfied
    session.change("a", "own", scale=-1.0).step(1)  # it bends the other way: not concave any more
    np.testing.assert_allclose(session.margins, [1.0 + np.sum((session.positions[0] - [3.0, 0.0]) ** 2)])
    with pytest.raises(cs.InvalidTeam, match=r"there is no parameter 'sale'.*did you mean 'scale'"):
        session.change("a", "own", sale=2.0)


def test_a_body_that_is_pushed_comes_back() -> None:
    session = cs.Session(trio(), rate=10, speed=2.0).step(60)
    assert session.satisfied
    session.place("a1", [5, 5])
    assert session.positions[0].tolist() == [5, 5]
    assert not session.satisfied
    session.step(1)
    assert np.linalg.norm(session.positions[0] - [5, 5]) == pytest.approx(0.2)
    session.step(60)
    assert session.satisfied
    jumps = cs.Session(trio()).step(20).place("a1", [5, 5]).step(20)
    assert jumps.satisfied


def test_a_result_is_of_the_team_as_it_is_also_before_the_next_step() -> None:
    session = cs.Session(trio()).step(20)
    assert session.result().summary["satisfied_from"]["round"] is not None
    result = session.place("a1", [50, 50]).result()
    assert (result.summary["status"], result.summary["satisfied_from"]["round"]) == ("not-converged", None)
    assert result.summary["positions"]["a1"] == [50, 50]
    assert result.summary["margin"] == session.margin == result.data["margin"].values[-1] < 0
    assert result.data["position"].values[-1, 0].tolist() == [50, 50]
    assert len(result.data["position"]) == 21
    result = session.step(20).add(cs.Agent("a4", [cs.near("a3", 1)], start=[-3, 0])).result()
    assert result.summary["positions"]["a4"] == [-3, 0]
    assert result.summary["margin"] == session.margin == result.data["margin"].values[-1]
    assert len(cs.Session(trio()).place("a1", [50, 50]).result().data["position"]) == 1


def test_steps_that_are_not_recorded_leave_nothing_behind(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("consat.engine.recording.MOST_KEPT", 600)
    session = cs.Session(trio())
    for _ in range(100):
        session.step()
    assert session._record.every > 1
    assert all(len(part.step) for part in session._record._rows)


def test_a_box_is_changed_as_a_whole() -> None:
    session = cs.Session(cs.Team([cs.Agent("a", [cs.box([0, 0], [1, 1]), cs.within([0, 0], 9)], start=[5, 5])])).step(20)
    session.change("a", "box", low=[2, 2], high=[3, 3]).step(30)
    assert np.all((session.positions[0] > 2) & (session.positions[0] < 3))
    with pytest.raises(cs.InvalidTeam, match=r"high is .* but must be above low"):
        session.change("a", "box", low=[4, 4])
    with pytest.raises(cs.InvalidSettings, match="rounds is -1"):
        session.step(-1)


def test_a_session_of_admm_carries_over_too() -> None:
    session = cs.Session(trio(), protocol="admm").step(30)
    assert session.satisfied
    session.add(cs.Agent("a4", [cs.near("a3", 1)])).step(3)
    assert session.margins[:3].min() > 0
    session.change("a1", "goal", center=[2.2, 0.2]).step(30)
    assert session.satisfied
    with pytest.raises(cs.InvalidSettings, match="a session goes in rounds"):
        cs.Session(trio(), protocol="gradient-flow")
