"""Who is satisfied is judged at bodies: what agents know of them is never ahead of where they are."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import consat as cs
from consat.engine.bodies import Body
from consat.engine.round import Seen, begin, many_rounds
from consat.engine.world import World, world_of
from consat.faults import Faults
from consat.numerics import float64, quick_compilation
from consat.problem.objective import SmoothingSchedule
from consat.problem.team import Team
from consat.problem.units import automatic, scale
from consat.protocols import Admm, agreement
from consat.protocols.estimates import Estimates
from consat.runs.preparation import first_estimates

SPEED = 0.5


def relayed() -> Team:
    """a1 must be near a3, whom it never talks to; a2 passes on where a3 is. They start far apart."""
    agents = [
        cs.Agent("a1", [cs.near("a3", radius=1)], start=[5, 0]),
        cs.Agent("a2", [cs.near("a1", radius=9)], start=[0, 4]),
        cs.Agent("a3", [cs.within([0, 0], radius=1)], start=[-4, 0]),
    ]
    return Team(agents, links=[("a1", "a2"), ("a2", "a3")], dimension=2)


TEAMS = {"case-c": cs.load("case-c").team, "relayed": relayed()}


def look(seen: Seen) -> tuple[Any, ...]:
    return seen.margin, seen.known, seen.position


@functools.cache
@float64
def follow(name: str, rounds: int, layout: str = "local", loss: float = 0.0) -> tuple[World, Any]:
    """What is seen of some rounds, and the state after the last."""
    team = TEAMS[name]
    copies, size = Estimates.of(team, layout), scale(team)  # type: ignore[arg-type]
    first = first_estimates(team, copies, cs.load("case-b").settings.start, size)
    nu = SmoothingSchedule.of(automatic(size)).final
    world = world_of(team, copies, nu, size, convex=True, faults=Faults(loss, seed=1), body=Body(10, SPEED))
    now, _ = jax.jit(begin, static_argnames=("protocol",), compiler_options=quick_compilation())(
        Admm(), world, jnp.asarray(first), jax.random.key(0)
    )
    run = jax.jit(many_rounds, static_argnames=("protocol", "look"), compiler_options=quick_compilation())
    now, seen = run(Admm(), world, now, jnp.arange(float(rounds)), look)
    return world, (now, *map(np.asarray, seen))


@pytest.mark.parametrize(("layout", "loss"), [("local", 0.0), ("full", 0.3)])
@pytest.mark.parametrize("team", TEAMS)
def test_nobody_knows_before_the_bodies_are_there(team: str, layout: str, loss: float) -> None:
    _, (_, margin, known, _) = follow(team, 200, layout, loss)
    known = known > 0
    assert known[-1]
    assert (margin[known] > 0).all()
    satisfied, sure = int(np.flatnonzero(margin <= 0).max()), int(np.flatnonzero(~known).max())
    assert satisfied > 50, "the bodies take their time, and the estimates don't"
    late = sure - satisfied
    assert 2 <= late <= (15 if loss else 4), "two links to cross, for word of a body, and then of what holds"


def test_where_bodies_are_where_the_estimates_are_nothing_is_told_of_them() -> None:
    plain, rated = cs.run("case-c", rounds=30, protocol="admm").summary, cs.run("case-c", rounds=30, rate=10, protocol="admm").summary
    assert (plain["known_from"], plain["floats_sent"]) == (rated["known_from"], rated["floats_sent"])
    slow = cs.run("case-c", rounds=30, rate=10, speed=1e9, protocol="admm").summary
    copies = Estimates.of(cs.load("case-c").team, "local")
    assert slow["floats_sent"] - plain["floats_sent"] == 30 * (2 * len(copies.links) + 3 * len(copies.edges)), "an age, and three a copy"


@float64
def test_word_of_a_body_takes_a_round_for_each_link() -> None:
    _, (now, _, _, position) = follow("relayed", 200)
    copies = Estimates.of(relayed(), "local")
    for agent, links in ((1, 1), (0, 2)):
        (row,) = copies.rows(np.array([agent]), np.array([2]))
        assert now.heard.stale[row] == links
        np.testing.assert_array_equal(now.heard.position[row], position[-links, 2])


@float64
def test_nobody_speaks_for_an_agent_that_speaks_for_itself() -> None:
    """a2 hears a3 itself, so what a1 says of a3 counts for nothing; of a1, which has only a2 to ask, it does."""
    world, (now, *_) = follow("relayed", 200)
    copies, solver, owners = Estimates.of(relayed(), "local"), world.everyone, world.owners
    assert owners is not None
    receiver, sender, _ = copies.ends()
    liar, d = copies.holder[sender] == 0, 2
    word = agreement.Word(jnp.full((len(receiver), d), 77.0), jnp.full(len(receiver), -9.0), jnp.zeros(len(receiver)))
    heard = agreement.hear_bodies(now.heard, word, jnp.asarray(liar), owners, solver)
    (row,) = copies.rows(np.array([1]), np.array([2]))
    np.testing.assert_array_equal(heard.position[row], now.heard.position[row])
    (row,) = copies.rows(np.array([0]), np.array([2]))
    heard = agreement.hear_bodies(now.heard, word, jnp.ones(len(receiver), dtype=bool), owners, solver)
    np.testing.assert_array_equal(heard.position[row], 77.0)
    assert heard.stale[row] == 1.0, "nothing is newer than new"
    own = copies.own
    np.testing.assert_array_equal(heard.position[own], now.heard.position[own])


@float64
def test_an_agent_that_does_not_know_where_it_is_counts_nothing() -> None:
    world, (now, *_) = follow("relayed", 200)
    solver, owners = world.everyone, world.owners
    assert owners is not None
    body = np.array(now.body)
    bodies, _ = agreement.speak_bodies(now.heard, jnp.asarray(body), owners, solver)
    assert (np.asarray(bodies.ages.age) > 0).all()
    body[0] = np.nan
    bodies, word = agreement.speak_bodies(now.heard, jnp.asarray(body), owners, solver)
    assert (np.asarray(bodies.ages.age) > 0).tolist() == [False, True, True]
    assert np.isfinite(np.asarray(word.position)).all()
    np.testing.assert_array_equal(bodies.position[owners.own[0]], now.body[0])
    unheard = now.heard._replace(stale=jnp.full_like(now.heard.stale, agreement.NEVER))
    bodies, _ = agreement.speak_bodies(unheard, jnp.asarray(np.array(now.body)), owners, solver)
    assert (np.asarray(bodies.ages.age) > 0).tolist() == [False, False, True], "two hold a copy of a body that they have not heard of"
