import re

import numpy as np
import pytest

import consat as cs
from consat.certify.optimum import max_min
from consat.certify.reasons import explain, restricted
from tests.unit.teams import case

A = cs.Agent


def sentences(team: cs.Team) -> list[str]:
    return explain(team, max_min(team))


def proposed(sentence: str) -> float:
    found = re.search(r"to (−?[\d.e−]+), would do", sentence)
    assert found, sentence
    return float(found[1].replace("−", "-"))


def tethered(tether: float) -> cs.Team:
    goal = cs.within([0, 0], 0.5, name="goal disc")
    return cs.Team([A("a2", [cs.near("a3", tether, name="tether"), goal]), A("a3", [cs.within([2, 0], 0.3, name="goal disc")])])


def test_a_conflict_is_named_and_its_cure_holds() -> None:
    """The discs are 1.2 apart."""
    (said,) = sentences(tethered(1.0))
    assert "a2's tether to a3" in said
    assert "a3's goal disc" in said
    assert "cannot all hold" in said
    assert "Raising the radius of a2's tether to a3 by" in said
    assert 1.2 < proposed(said) <= 1.21  # two digits of the change, rounded up
    assert max_min(tethered(proposed(said))).margin > 0


@pytest.mark.parametrize("unit", [1e-3, 1.0, 1e3])
def test_units_do_not_matter(unit: float) -> None:
    (said,) = sentences(case("d", unit))
    assert "cannot all hold" in said
    assert proposed(said) == pytest.approx(1.61 * unit)


def test_a_wall_gives_way() -> None:
    """x ≥ 3 for a disc of radius 1 at 0."""
    (said,) = sentences(cs.Team([A("a", [cs.halfspace([-1, 0], -3), cs.within([0, 0], 1)])]))
    assert "a's halfspace and a's within cannot both hold" in said
    assert "the offset of a's halfspace" in said
    assert -1 < proposed(said) <= -0.9


def test_a_side_of_a_box_gives_way() -> None:
    (said,) = sentences(cs.Team([A("a", [cs.box([0, 0], [2, 1])]), A("b", [cs.near("a", 0.5), cs.box([3, 0], [5, 1])])]))
    assert "−0.1743" in said
    assert "Lowering the low[0] of b's box.low[0]" in said
    assert 2.49 <= proposed(said) < 2.5


def test_an_expression_is_told_how_far_it_may_fall_short() -> None:
    def team(leash: float) -> cs.Team:
        return cs.Team([A("a", [cs.expr(f"{leash} - norm2(a)", name="leash"), cs.expr("1000 * (a.x - 3)")])])

    (said,) = sentences(team(1.0))
    found = re.search(r"Letting ψ of a's leash fall short of 0 by ([\d.]+) would do", said)
    assert found, said
    assert 8.0 < float(found[1]) <= 8.1  # x² = 9 where 1 is allowed
    assert max_min(team(1.0 + float(found[1]))).margin > 0


def test_several_conflicts_have_a_sentence_each() -> None:
    clash = [cs.within([0, 0], 1), cs.within([3, 0], 1)]
    said = sentences(cs.Team([A("a", clash), A("b", clash), A("c", clash[:1])]))
    assert len(said) == 2
    assert said[0].startswith("a's within")
    assert said[1].startswith("b's within")


def test_no_cure_is_proposed_where_one_change_is_not_enough() -> None:
    clash = [cs.within([0, 0], 1), cs.within([3, 0], 1)]
    (said,) = sentences(cs.Team([A("a", [*clash, cs.near("b", 10)]), A("b", clash)]))
    assert "cannot all hold" in said
    assert "would do" not in said


def test_what_is_not_proven_is_not_said() -> None:
    """Not concave: the best found is not the best possible."""
    (said,) = sentences(cs.Team([A("a", [cs.within([0, 0], 1)]), A("b", [cs.within([0, 0], 1), cs.apart("a", 2.5)])]))
    assert "No formation was found" in said
    assert "cannot" not in said
    assert "Lowering the radius of b's apart(a)" in said
    assert 1.9 < proposed(said) < 2


def test_a_feasible_team_is_told_what_limits_it() -> None:
    (said,) = sentences(case("c"))
    assert said.startswith("Every constraint can hold. The best margin is 0.1861, limited by a2's near(a3)")


def test_of_many_that_bind_a_little_each_some_are_named() -> None:
    (said,) = sentences(cs.load("convoy", ["count=2500"]).team)
    assert "limited by a1's goal" in said
    assert "and 2494 more" in said


def test_teams_without_limits() -> None:
    assert sentences(cs.Team([A("a")])) == ["No agent has a constraint."]
    assert "Nothing limits" in sentences(cs.Team([A("a", [cs.halfspace([1, 0], 1)])]))[0]


def test_restricted_keeps_order_and_names() -> None:
    team = restricted(case("d"), np.array([False, True, False, True]))
    assert list(team.names) == ["near(a1)", "within"]
    assert team.owner.tolist() == [1, 2]
    assert sorted(np.concatenate([family.number for family in team.families])) == [0, 1]


@pytest.mark.parametrize(
    ("psi", "margin"), [("-1 + 0*norm2(a)", -1.0), ("0*norm2(a)", 0.0), ("0*exp(norm2(a))", 0.0), ("tanh(0*norm2(a)) - 1", -1.0)]
)
def test_a_constant_is_told_as_any_other(psi: str, margin: float) -> None:
    """Nothing is divided by a slope or a size that is 0; warnings are errors here."""
    (said,) = sentences(cs.Team([A("a", [cs.expr(psi)]), A("b", [cs.near("a", 1)])]))
    assert f"a's expr cannot hold: the best margin is {margin:.4g}".replace("-", "−") in said
    assert "Letting ψ of a's expr fall short of 0 by" in said


def test_where_nothing_is_a_number_no_cure_is_sought() -> None:
    (said,) = sentences(cs.Team([A("a", [cs.expr("log(-1 - norm2(a))"), cs.within([0, 0], 1)])]))
    assert said == "No formation was found at which ψ of a's expr is a finite number."
