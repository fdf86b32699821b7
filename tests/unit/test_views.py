"""Figures, films and words say what the result says: curves, circles, colours and labels are read back and compared."""

from __future__ import annotations

import itertools
import logging
import subprocess
import sys
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from matplotlib import pyplot
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cbook import is_math_text
from matplotlib.collections import EllipseCollection
from matplotlib.colors import to_hex, to_rgb
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from PIL import Image

import consat as cs
from consat.errors import InvalidSettings
from consat.numerics import float64
from consat.problem.objective import Nu, Objective
from consat.problem.team import Team
from consat.results.result import Result
from consat.results.trace import Trace, satisfied_from
from consat.views import animation, colours, figures, regions, scene, words

GREETING = np.array([[2.0, 0.0], [-0.6, 0.0], [-2.0, 0.0]])


def tug(near: float = 3.0, nearer: float = 2.0) -> Team:
    """The paper's cases B to D."""
    agents = [
        cs.Agent("a1", [cs.within([2, 0], 1)]),
        cs.Agent("a2", [cs.near("a1", near), cs.near("a3", nearer)]),
        cs.Agent("a3", [cs.within([-2, 0], 1)]),
    ]
    return cs.Team(agents, links="line")


@jax.jit
def observed(observer: Objective, x: jax.Array) -> tuple[jax.Array, ...]:
    """Agent margins, smooth margin, every ψ and every multiplier at the formations (T, N, d)."""
    nu = Nu(5.0, 5.0)
    return jax.vmap(lambda p: (observer.agent_margins(p), observer.smooth_margin(p, nu), observer.psi(p), observer.multipliers(p, nu)))(x)


@float64
def made(
    team: Team,
    end: np.ndarray,
    clock: Literal["time", "round"] = "time",
    samples: int = 60,
    spread: float = 3.0,
    copies: bool = True,
    **changes: Any,
) -> Result:
    """A run that never was: every agent on a straight way from a random start, fast at first, to a given end."""
    random = np.random.default_rng(0)
    start = end + random.uniform(-spread, spread, end.shape)
    steps = np.linspace(0.0, 300.0, samples) if clock == "time" else np.arange(samples)
    x = end + np.exp(-20 * np.arange(samples) / samples)[:, None, None] * (start - end)
    x[-1] = end
    own, smooth, psi, multiplier = map(np.asarray, observed(Objective.at_positions(team), jnp.asarray(x)))
    margin, psi, multiplier = own.min(axis=1), psi[-1], multiplier[-1]
    count, since = team.count, satisfied_from(steps, margin, interpolate=clock == "time")
    holder, held = (index.ravel() for index in np.meshgrid(np.arange(count), np.arange(count), indexing="ij"))
    estimate = x[:, held] * (1 + 0.1 * holder[:, None]) if copies else None
    trace = Trace(
        clock, steps, x, 0 * x, margin, smooth, own, estimate, None if estimate is None else 0.5 * estimate, holder, held,
        np.zeros(count, dtype=int), "settled", since, None, None, None, None, {"compile": 0.0, "run": 0.0},
    )  # fmt: skip
    entries = {
        agent: {
            "margin": float(own[-1, i]) if np.isfinite(own[-1, i]) else None,
            "constraints": [
                {"name": team.names[k], "margin": float(psi[k]), "multiplier": float(multiplier[k])}
                for k in np.flatnonzero(team.owner == i)
            ],
        }
        for i, agent in enumerate(team.ids)
    }
    bounds = [float(margin[-1]), float(margin[-1]) + 0.05] if len(psi) else [None, None]
    summary = {
        "scenario": "made up", "version": "0", "protocol": "gradient-flow", "estimates": "full", "seed": 7, "ending": "settled",
        "status": "satisfied" if margin[-1] > 0 else "least-violating", "verdict": "feasible" if margin[-1] > 0 else "infeasible",
        "margin": float(margin[-1]), "smooth_margin": float(smooth[-1]), "bounds": bounds,
        "satisfied_from": {"time": since if clock == "time" else None, "round": since if clock == "round" else None},
        "rounds": samples - 1 if clock == "round" else None, "messages": None, "floats_sent": None, "count": count,
        "positions": {agent: row.tolist() for agent, row in zip(team.ids, end, strict=True)}, "agents": entries,
    }  # fmt: skip
    return Result(summary | changes, trace=trace, team=team)


def patches(figure: Figure, gid: str) -> list[Any]:
    """What is drawn on the axes under a name."""
    return [patch for patch in figure.axes[0].patches if patch.get_gid() == gid and len(patch.get_path().vertices)]


def boundaries(figure: Figure) -> list[Any]:
    return patches(figure, "boundary")


def shadings(figure: Figure) -> list[Any]:
    return patches(figure, "region")


def vertices(patch: Any) -> np.ndarray:
    return np.asarray(patch.get_path().vertices)


def cell(figure: Figure) -> float:
    """The width of a cell of the grid on which ψ was evaluated."""
    axes = figure.axes[0]
    return max(np.ptp(axes.get_xlim()), np.ptp(axes.get_ylim())) / (scene.GRID - 1)


def legend(figure: Figure) -> list[str]:
    found = figure.axes[0].get_legend()
    assert found is not None
    return [text.get_text() for text in found.get_texts()]


# ---- regions


@pytest.mark.parametrize("letter", ["within", "expr", "callable"])
def test_boundary_of_a_region_is_its_circle_whoever_wrote_it(letter: str) -> None:
    center = np.array([0.5, -0.25])
    ball = {
        "within": cs.within(center, 1.5),
        "expr": cs.expr("1.5**2 - (a[0] - 0.5)**2 - (a[1] + 0.25)**2"),
        "callable": cs.constraint(lambda a, radius: radius**2 - jnp.sum((a - center) ** 2), reads=("a",), radius=1.5),
    }[letter]
    figure = figures.formation(made(cs.Team([cs.Agent("a", [ball])]), center[None]))
    [edge] = boundaries(figure)
    error = np.abs(np.linalg.norm(vertices(edge) - center, axis=1) - 1.5)
    assert len(vertices(edge)) > 100
    assert figure.axes[0].get_aspect() == 1
    # Between grid points the contour interpolates: ψ'' = −2 along each axis errs by h²/4, and |∇ψ| = 2r.
    assert error.max() <= cell(figure) ** 2 / (8 * 1.5) * 1.01


def test_region_of_a_tie_is_around_the_teammate_where_it_ends() -> None:
    figure = figures.formation(made(tug(), GREETING))
    centers, radii = GREETING[[0, 0, 2, 2]] * [1, 0], [1.0, 3.0, 2.0, 1.0]
    edges = boundaries(figure)
    assert [to_hex(edge.get_edgecolor()) for edge in edges] == [colours.colour(i).lower() for i in (0, 1, 1, 2)]
    for edge, center, radius in zip(edges, centers, radii, strict=True):
        assert np.linalg.norm(vertices(edge) - center, axis=1) == pytest.approx(radius, abs=cell(figure) ** 2)


def test_shading_is_where_all_constraints_of_the_agent_hold() -> None:
    figure = figures.formation(made(tug(), GREETING))
    shade = shadings(figure)[1]
    lens = [[-0.5, 0.0], [-0.7, 1.0], [0.5, 0.0], [-1.5, 0.0]]  # the second is near both, the others near one only
    inside = [shade.get_path().contains_point(point) for point in lens]
    assert inside == [True, True, False, False]


def test_nothing_is_shaded_where_constraints_exclude_each_other() -> None:
    end = np.array([[0.98, 0.0], [-0.41, 0.0], [-0.98, 0.0]])
    figure = figures.formation(made(tug(1.4, 0.4), end))
    assert len(boundaries(figure)) == 4
    assert [to_hex(shade.get_facecolor()) for shade in shadings(figure)] == [colours.colour(i).lower() for i in (0, 2)]


def test_ticks_stand_on_the_side_where_the_constraint_fails() -> None:
    figure = figures.formation(made(cs.Team([cs.Agent("a", [cs.halfspace([1, 0], 1)])]), np.array([[0.5, 0.2]])))
    [strokes] = patches(figure, "ticks")
    feet, tips = vertices(strokes).reshape(-1, 2, 2).swapaxes(0, 1)
    assert feet[:, 0] == pytest.approx(1.0)
    assert np.all(tips[:, 0] > feet[:, 0])
    assert "forbidden side" in legend(figure)


@pytest.mark.parametrize("own", ["outside", "expr"])
def test_what_keeps_out_is_hatched_and_a_goal_is_not(own: str) -> None:
    bar = cs.outside([0, 0], 1) if own == "outside" else cs.expr("a[0]**2 + a[1]**2 - 1")
    figure = figures.formation(made(cs.Team([cs.Agent("a", [bar, cs.within([3, 0], 1)])]), np.array([[3.0, 0.0]])))
    [keep_out] = patches(figure, "keep-out")
    assert keep_out.get_hatch()
    assert keep_out.get_path().contains_point((0, 0.5))
    assert not keep_out.get_path().contains_point((3, 0))
    [region] = shadings(figure)
    assert region.get_path().contains_point((3, 0.5))
    assert not region.get_path().contains_point((0, 0.5))
    assert [text for text in legend(figure) if text.startswith("a: ")] == [f"a: {own}, keep out", "a: within"]


def test_what_several_agents_share_is_drawn_once() -> None:
    agents = [cs.Agent(f"a{i}", [cs.within([0, 0], 2), cs.outside([0, 0], 0.5)]) for i in range(4)]
    end = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])
    figure = figures.formation(made(cs.Team(agents, links="line"), end))
    assert [len(found) for found in (boundaries(figure), shadings(figure), patches(figure, "keep-out"))] == [2, 1, 1]
    assert {"4 agents: within", "4 agents: outside, keep out"} <= set(legend(figure))


def test_sides_of_a_box_have_one_name() -> None:
    figure = figures.formation(made(cs.Team([cs.Agent("a", [*cs.box([0, 0], [1, 2])])]), np.array([[0.5, 0.5]])))
    assert [text for text in legend(figure) if text.startswith("a: ")] == ["a: box"]
    assert len(boundaries(figure)) == 4


def test_axes_name_the_unit_of_the_scenario() -> None:
    figure = figures.formation(made(cs.Team([cs.Agent("a", [cs.within([0, 0], 1)])], unit="m"), np.zeros((1, 2))))
    assert (figure.axes[0].get_xlabel(), figure.axes[0].get_ylabel()) == ("position x [m]", "position y [m]")
    assert figures.formation(made(tug(), GREETING)).axes[0].get_xlabel() == "position x"


def test_regions_move_the_owner_and_nobody_else() -> None:
    team = cs.Team([cs.Agent("a"), cs.Agent("b", [cs.displacement("a", [1, 2], 3, weight=2)])])
    x, points = np.array([[0.5, 0.5], [9.0, 9.0]]), np.array([[0.0, 0.0], [1.5, 2.5], [4.0, -1.0]])
    expected = 2 * (9 - np.sum((points - x[0] - [1, 2]) ** 2, axis=1))
    assert regions.regions(team, x, points) == pytest.approx(expected[None], rel=1e-14)


def test_region_in_one_dimension_follows_the_teammate_in_time() -> None:
    team = cs.Team([cs.Agent("a", [cs.within([0], 1)]), cs.Agent("b", [cs.near("a", 2)])], dimension=1)
    result = made(team, np.array([[0.0], [1.0]]))
    _, low_or_high = boundaries(figures.formation(result))
    time, place = vertices(low_or_high).T
    a = np.interp(time, result.data["time"], result.data["position"].values[:, 0, 0])
    assert np.abs(place - a) == pytest.approx(2.0, abs=0.05)  # ψ is sampled at 200 moments only


def test_view_holds_formation_and_regions_and_cuts_starts_from_far() -> None:
    near, far = (figures.formation(made(tug(), GREETING, spread=spread)).axes[0] for spread in (2.0, 500.0))
    for axes in (near, far):
        assert axes.get_xlim()[0] < -4 < 5 < axes.get_xlim()[1]
        assert axes.get_ylim()[0] < -3 < 3 < axes.get_ylim()[1]
        assert np.ptp(axes.get_xlim()) < 25
    assert "starts out of view" in far.get_title()
    assert "starts" not in near.get_title()


# ---- the formation otherwise


def test_paths_lead_from_open_starts_to_filled_ends() -> None:
    result = made(tug(), GREETING)
    lines = figures.formation(result).axes[0].lines
    x = result.data["position"].values
    for i in range(3):
        mine = [line for line in lines if line.get_color() == colours.colour(i)]
        mine.sort(key=lambda line: ["path", "start", "head"].index(line.get_gid()))
        path, start, end = (line.get_xydata() for line in mine)
        assert np.array_equal(path, x[:, i])
        assert np.array_equal(start, x[:1, i])
        assert np.array_equal(end, x[-1:, i])
        assert mine[1].get_markerfacecolor() == "white"
        assert mine[2].get_markerfacecolor() == colours.colour(i)


def test_legend_names_agents_and_constraints() -> None:
    texts = legend(figures.formation(made(tug(), GREETING)))
    assert texts[:3] == ["a1", "a2", "a3"]
    assert {"a1: within", "a2: near(a1)", "a2: near(a3)", "a3: within"} <= set(texts)


def test_names_of_agents_that_meet_do_not_cover_each_other() -> None:
    figure = figures.formation(made(cs.Team([cs.Agent(f"a{i}", [cs.within([2, 0], 1)]) for i in range(4)]), np.tile([2.0, 0.0], (4, 1))))
    drawn(figure)
    boxes = [text.get_window_extent() for text in figure.axes[0].texts]
    assert len(boxes) == 4
    assert not any(a.overlaps(b) for a, b in itertools.combinations(boxes, 2))


def named(figure: Figure, gid: str) -> list[Any]:
    return [artist for artist in figure.axes[0].get_children() if artist.get_gid() == gid]


def crowd(count: int, **keywords: Any) -> Result:
    """Agents in a row, each in its region, the first five outside; around a keep-out that they share."""
    agents = [cs.Agent(f"q{i}", [cs.within([i, 0], 1), cs.outside([count / 2, 4], 2)]) for i in range(count)]
    end = np.stack([np.arange(float(count)), np.where(np.arange(count) < 5, 2.0, np.linspace(0, 0.8, count))], axis=1)
    return made(cs.Team(agents, links="line"), end, samples=6, **keywords)


def test_many_agents_are_coloured_by_margin() -> None:
    result = crowd(20)
    figure = figures.formation(result)
    [heads] = named(figure, "head")
    red, _, blue, _ = heads.get_facecolor().T
    assert np.array_equal(heads.get_offsets(), result.data["position"].values[-1])
    assert np.array_equal(red > blue, np.arange(20) < 5)
    assert len(np.unique(heads.get_facecolor()[5:], axis=0)) >= 4  # the satisfied use the whole scale


@pytest.mark.parametrize("margins", [[0.8, 0.9, 0.95, 1.0], [-5.0, -1.0, 0.5, 1e6], [-3.0, -2.0, -1.0, -1.0], [1.0] * 4, [np.inf] * 4])
def test_scale_of_margins_splits_at_zero_and_is_used_as_a_whole(margins: list[float]) -> None:
    values = np.array(margins)
    palette, norm, edges, extend = colours.classes(values)
    shades = palette(norm(np.ma.masked_invalid(values)))
    assert 0.0 in edges
    assert list(edges) == sorted(set(edges))
    finite = np.isfinite(values)
    assert np.array_equal(shades[finite, 0] > shades[finite, 2], values[finite] <= 0)
    assert len(np.unique(shades[finite], axis=0)) == len(set(values[finite]))
    assert extend == ("min" if not (values < 0).any() else "max" if not (values[finite] > 0).any() else "neither")
    assert palette(norm(-1e9))[0] > palette(norm(-1e9))[2]  # whatever came before the end


@pytest.mark.parametrize("count", [13, 50])
def test_a_crowd_has_a_legend_regions_keep_outs_and_links_unlike_paths(count: int) -> None:
    figure = figures.formation(crowd(count))
    [union] = named(figure, "region")
    assert union.get_path().contains_point((4, 0.5))
    [discs] = [edges for edges in named(figure, "boundary") if isinstance(edges, EllipseCollection)]
    assert len(discs.get_offsets()) == count
    assert len(patches(figure, "keep-out")) == 1
    [told] = figure.legends
    assert [text.get_text() for text in told.get_texts()] == [
        "agent",
        "start and path",
        "communication link",
        "region to be in",
        "keep-out",
    ]
    [links], [paths] = named(figure, "link"), named(figure, "path")
    lightness = [np.dot([0.2126, 0.7152, 0.0722], np.array(to_rgb(line.get_color())) ** 2.2) for line in (links, paths)]
    assert (max(lightness) + 0.05) / (min(lightness) + 0.05) > 4.5  # contrast, as WCAG counts it
    texts = [text.get_text() for text in figure.axes[0].texts]
    assert 1 <= len(texts) <= 3
    assert set(texts) <= {f"q{i}" for i in range(5)}


def test_a_thousand_agents_are_drawn_quickly_and_nothing_is_cut_off() -> None:
    figure = figures.formation(crowd(1000, copies=False))
    renderer = drawn(figure)
    used, (width, height) = figure.get_tightbbox(renderer), figure.get_size_inches()
    assert (used.x0 > -0.02, used.y0 > -0.02, used.x1 < width + 0.02, used.y1 < height + 0.02) == (True,) * 4
    assert len(figure.axes[0].get_children()) < 60


def test_a_result_without_its_team_still_shows_its_paths() -> None:
    whole = made(tug(), GREETING)
    figure = figures.formation(Result(whole.summary, whole.data))
    assert boundaries(figure) == []
    assert legend(figure) == ["a1", "a2", "a3", "start"]


def test_formation_draws_on_given_axes() -> None:
    figure = Figure()
    left, right = figure.subplots(1, 2)
    assert figures.formation(made(tug(), GREETING), right) is figure
    assert not left.has_data()
    assert right.has_data()


# ---- margins


def test_satisfaction_is_marked_where_it_begins() -> None:
    result = made(tug(), GREETING)
    since = result.summary["satisfied_from"]["time"]
    axes = figures.margins(result).axes[0]
    [mark] = [line for line in axes.lines if line.get_linestyle() == ":"]
    assert list(mark.get_xdata()) == [since, since]
    assert [text.get_text().strip() for text in axes.texts] == [f"satisfied from t = {since:.3g} s"]


@pytest.mark.parametrize(("spread", "scale"), [(0.3, "linear"), (30.0, "asinh")])
def test_margins_stay_readable_beside_a_huge_first_violation(spread: float, scale: str) -> None:
    result = made(tug(), GREETING, clock="round", spread=spread)
    axes = figures.margins(result).axes[0]
    assert axes.get_yscale() == scale
    curve = axes.lines[1]
    assert np.array_equal(curve.get_ydata(), result.data["margin"])
    last = axes.transAxes.inverted().transform(axes.transData.transform(curve.get_xydata()[-1]))[1]
    zero = axes.transAxes.inverted().transform(axes.transData.transform((0, 0)))[1]
    assert last - zero > 0.1  # of the height of the axes


def test_unsatisfied_run_has_no_mark_and_bounds_are_a_band() -> None:
    end = np.array([[0.98, 0.0], [-0.41, 0.0], [-0.98, 0.0]])
    result = made(tug(1.4, 0.4), end, bounds=[-0.2, -0.1])
    axes = figures.margins(result).axes[0]
    assert not axes.texts
    [band] = axes.patches
    assert (band.get_y(), band.get_y() + band.get_height()) == pytest.approx((-0.2, -0.1))
    assert band.get_label() == "best possible margin, proven: −0.2 to −0.1"


def test_open_bounds_are_not_drawn() -> None:
    assert not figures.margins(made(tug(), GREETING, bounds=[1.0, None])).axes[0].patches


# ---- estimates and integral states


@pytest.mark.parametrize(("draw", "name"), [(figures.estimates, "estimate"), (figures.integrals, "integral")])
def test_colour_is_the_coordinate_and_line_style_the_holder(draw: Any, name: str) -> None:
    result = made(tug(), GREETING)
    lines: list[Line2D] = list(draw(result).axes[0].lines)
    data = result.data[name]
    assert len(lines) == 9 * 2
    for line, (copy, axis) in zip(lines, itertools.product(range(9), range(2)), strict=True):
        assert np.array_equal(line.get_ydata(), data.values[:, copy, axis])
    styles = [line._unscaled_dash_pattern for line in lines]
    for one, other in itertools.combinations(range(18), 2):
        same_coordinate = data.held.values[one // 2] == data.held.values[other // 2] and one % 2 == other % 2
        assert np.array_equal(lines[one].get_color(), lines[other].get_color()) == same_coordinate
        assert (styles[one] == styles[other]) == (data.holder.values[one // 2] == data.holder.values[other // 2])
    texts = [text.get_text() for text in lines[0].axes.get_legend().get_texts()]
    assert texts == [f"{axis} of a{i}" for i in (1, 2, 3) for axis in "xy"] + [f"held by a{i}" for i in (1, 2, 3)]


def test_what_was_not_recorded_is_not_drawn(tmp_path: Path) -> None:
    result = made(tug(), GREETING, copies=False)
    assert figures.estimates(result) is None
    assert figures.integrals(result) is None
    assert [path.name for path in figures.save(result, tmp_path / "new")] == ["formation.png", "margins.png"]


def test_of_many_copies_the_spread_is_drawn() -> None:
    team = cs.Team([cs.Agent(f"q{i}", [cs.within([i, 0], 1)]) for i in range(30)], dimension=2, unit="m")
    result = made(team, np.zeros((30, 2)), samples=5)
    figure = figures.estimates(result)
    assert figure is not None
    axes = figure.axes[0]
    wrong = np.linalg.norm(result.data["estimate"].values - result.data["position"].values[:, np.tile(np.arange(30), 30)], axis=2)
    others = wrong[:, ~np.eye(30, dtype=bool).ravel()]
    median, largest = axes.lines
    assert median.get_ydata() == pytest.approx(np.median(others, axis=1))
    assert largest.get_ydata() == pytest.approx(others.max(axis=1))
    assert "870 copies" in axes.get_title()
    assert axes.get_ylabel() == "distance of the estimate from the position [m]"


# ---- the page

NAMES = ["_hidden", "pay$1$now", "an-agent-with-a-long-name", "ü"]
LONG = cs.Team([cs.Agent(name, [cs.within([k, 0], 1, name=f"a constraint whose name is too long {k}")]) for k, name in enumerate(NAMES)])
CROWD = cs.Team([cs.Agent(f"q{i}", [cs.within([i, 0], 1)]) for i in range(20)])
PAGES = {
    "few": (tug(), GREETING),
    "names": (LONG, np.stack([np.arange(4.0), np.zeros(4)], axis=1)),
    "twelve": (cs.Team([cs.Agent(f"q{i}", [cs.within([i, 0], 1), cs.outside([i, 2], 1)]) for i in range(12)]), np.zeros((12, 2))),
    "crowd": (CROWD, np.stack([np.arange(20.0), np.zeros(20)], axis=1)),
    "line": (cs.Team([cs.Agent("a", [cs.within([0], 1)]), cs.Agent("b", [cs.near("a", 1)])], dimension=1), np.zeros((2, 1))),
    "space": (cs.Team([cs.Agent("a", [cs.within([0, 1, 2], 1)]), cs.Agent("b", [cs.near("a", 1)])], dimension=3), np.ones((2, 3))),
    "beyond": (cs.Team([cs.Agent("a", [cs.within([0] * 5, 1)]), cs.Agent("b", [cs.near("a", 1)])], dimension=5), np.zeros((2, 5))),
    "free": (cs.Team([cs.Agent("a"), cs.Agent("b")], links="complete"), np.array([[0.0, 0.0], [1.0, 1.0]])),
}


def drawn(figure: Figure) -> Any:
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return canvas.get_renderer()


@pytest.mark.parametrize("draw", [figures.formation, figures.margins, figures.estimates, figures.integrals])
@pytest.mark.parametrize("page", PAGES)
def test_nothing_is_cut_off_and_the_legend_covers_nothing(page: str, draw: Any) -> None:
    team, end = PAGES[page]
    figure = draw(made(team, end, samples=12, clock="round"))
    renderer = drawn(figure)
    used, (width, height) = figure.get_tightbbox(renderer), figure.get_size_inches()
    assert min(used.x0, used.y0) > -0.02  # inches
    assert used.x1 < width + 0.02
    assert used.y1 < height + 0.02
    axes = figure.axes[0]
    if axes.get_legend() is not None:
        assert not axes.get_legend().get_window_extent(renderer).overlaps(axes.get_window_extent(renderer))
    labels = [axes.get_title(), axes.get_xlabel(), axes.get_ylabel()]
    assert all(labels)


def test_names_are_shown_as_they_are_written() -> None:
    team, end = PAGES["names"]
    figure = figures.formation(made(team, end))
    shown = legend(figure)
    assert not any(is_math_text(text) for text in shown)
    assert [text.replace(r"\$", "$") for text in shown[:4]] == ["_hidden", "pay$1$now", "an-agent-with…", "ü"]


def test_beyond_three_dimensions_the_title_says_what_is_shown() -> None:
    axes = figures.formation(made(*PAGES["beyond"])).axes[0]
    assert "the first two of 5 axes" in axes.get_title()
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("position x1", "position x2")


def test_regions_keep_outs_and_boxes_are_drawn_in_space() -> None:
    own = [cs.within([0, 1, 2], 1), cs.outside([4, 0, 0], 1.5), *cs.box([-3, -3, -1], [6, 3, 4])]
    team = cs.Team([cs.Agent("a", own), cs.Agent("b", [cs.near("a", 1), cs.expr("4 - b[0]**2 - b[1]**2 - 2 * b[2]**2")])], dimension=3)
    figure = figures.formation(made(team, np.ones((2, 3)), spread=1.0))
    drawn(figure)
    rings = [np.concatenate(lines._segments3d) for lines in named(figure, "boundary")]
    within, outside, section, near = rings
    for points, center, radius in ((within, [0, 1, 2], 1), (outside, [4, 0, 0], 1.5), (near, [1, 1, 1], 1)):
        assert np.linalg.norm(points - center, axis=1) == pytest.approx(radius)
    psi = 4 - section[:, 0] ** 2 - section[:, 1] ** 2 - 2 * section[:, 2] ** 2
    assert np.abs(psi).max() < 0.1  # between grid points a section interpolates
    solids = named(figure, "keep-out")
    assert len(solids) == 1
    faces = [np.asarray(face._faces) for face in named(figure, "region") if len(face._faces) == 1]
    corners = np.unique(np.round(np.concatenate(faces).reshape(-1, 3), 9) + 0.0, axis=0)
    assert corners.tolist() == [[x, y, z] for x in (-3, 6) for y in (-3, 3) for z in (-1, 4)]
    assert named(figure, "shadow")
    assert not any("`" in text for text in legend(figure))
    assert {"a: within", "a: outside, keep out", "a: box", "b: near(a)", "b: expr"} <= set(legend(figure))


def test_a_run_that_diverged_or_never_moved_can_be_looked_at() -> None:
    still = made(tug(), GREETING, samples=1, clock="round")
    gone = made(tug(), GREETING * 1e120)
    data = gone.data.where(gone.data["time"] < 200)
    gone = Result(gone.summary, data, team=gone.team)
    for result in (still, gone):
        for draw in (figures.formation, figures.margins, figures.estimates):
            figure = draw(result)
            assert figure is not None
            drawn(figure)


def test_save_writes_pictures_of_150_dots_per_inch(tmp_path: Path) -> None:
    paths = figures.save(made(tug(), GREETING), tmp_path / "deep" / "folder")
    assert [path.name for path in paths] == ["formation.png", "margins.png", "estimates.png", "integrals.png"]
    for path in paths:
        with Image.open(path) as picture:
            assert picture.info["dpi"] == pytest.approx((150, 150), abs=0.1)
            assert picture.width > 1000


def test_without_a_display_show_says_what_to_do(caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        assert figures.show(made(tug(), GREETING)) == []
    assert "writes them into a directory" in caplog.text


def test_with_a_display_show_opens_every_figure() -> None:
    pyplot.switch_backend("module://matplotlib.backends.backend_template")  # what an interactive one implements, without a window
    try:
        assert figures.show(made(tug(), GREETING)) == []
        titles = [pyplot.figure(number).axes[0].get_title() for number in pyplot.get_fignums()]
    finally:
        pyplot.close("all")
        pyplot.switch_backend("agg")
    assert [title.split()[-1] for title in titles] == ["1", "team", "positions", "states"]


# ---- the film


def test_film_has_its_frames_its_size_and_its_length(tmp_path: Path) -> None:
    done: list[float] = []
    path = animation.save(made(tug(), GREETING), tmp_path / "new" / "film.gif", seconds=2.0, fps=10, progress=done.append)
    with Image.open(path) as film:
        frames = [film.seek(k) or (film.info["duration"], film.convert("RGB")) for k in range(film.n_frames)]
    durations = [duration for duration, _ in frames]
    assert len(frames) == 18  # the end is one frame, shown for the last tenth
    assert sum(durations) == 2000
    assert set(durations[:-1]) == {100}
    pictures = [np.asarray(picture) for _, picture in frames]
    assert {picture.shape for picture in pictures} == {(468, pictures[0].shape[1], 3)}
    assert all(np.any(a != b) for a, b in itertools.pairwise(pictures))
    assert all(tuple(picture[-1, -1]) == (255, 255, 255) for picture in pictures)
    assert done == pytest.approx(np.arange(1, 21) / 20)


@pytest.mark.parametrize("page", ["crowd", "line", "space"])
def test_every_kind_of_team_can_be_filmed(page: str, tmp_path: Path) -> None:
    path = animation.save(made(*PAGES[page], clock="round", samples=4), tmp_path / "film.gif", seconds=0.7)
    with Image.open(path) as film:
        assert film.n_frames >= 6


def test_film_is_a_gif_or_a_video() -> None:
    with pytest.raises(InvalidSettings, match=r"a film ends in \.gif or \.mp4, but film\.avi doesn't; write film\.gif"):
        animation.save(made(tug(), GREETING), "film.avi")


def test_scene_shows_what_is_between_samples() -> None:
    result = made(tug(), GREETING, clock="round", samples=9)
    shown = scene.Scene(result)
    shown.show(2.25)
    x = result.data["position"].values
    heads = [line for line in shown.axes.lines if line.get_gid() == "head"]
    assert np.concatenate([line.get_xydata() for line in heads]) == pytest.approx(0.75 * x[2] + 0.25 * x[3])
    assert "round 2," in shown.axes.get_title()
    edge = next(edge for edge in boundaries(shown.figure) if to_hex(edge.get_edgecolor()) == colours.colour(1).lower())
    assert np.linalg.norm(vertices(edge) - heads[0].get_xydata(), axis=1) == pytest.approx(3.0, abs=cell(shown.figure) ** 2)


def test_scene_leaves_nothing_behind() -> None:
    shown = scene.Scene(made(tug(), GREETING))
    shown.show(0)
    before, moving = len(shown.axes.get_children()), list(shown.moving)
    shown.show(5)
    assert len(shown.axes.get_children()) == before
    assert shown.moving == moving  # the same artists, moved: to make them anew took most of the time of a film


def test_film_dwells_on_what_moves() -> None:
    shown = scene.Scene(made(tug(), GREETING, samples=400))
    moments = shown.record.moments(100, animation.MOVEMENT)
    assert moments[0] == 0
    assert moments[-1] == shown.last
    assert np.all(np.diff(moments) > 0)
    assert np.count_nonzero(moments < 80) > 65  # by then all but e⁻⁴ of the way is done, in a fifth of the time


# ---- words


def test_words_say_what_matters() -> None:
    text = str(made(tug(), GREETING))
    lines = text.splitlines()
    assert lines[0] == "made up: every constraint holds; the team has settled"
    assert "  margin          1 (smooth margin 0.8606)" in lines
    assert "  best possible   between 1 and 1.05, proven" in lines
    assert any(line.startswith("  satisfied from  t = ") for line in lines)
    assert "  binding         a1: within 0.50, a3: within 0.50" in lines
    assert "  positions       a1  ( 2.000,  0.000)  margin 1" in lines
    assert len(lines) < 25
    assert text.isascii()  # for every terminal


def test_words_of_an_infeasible_run() -> None:
    end = np.array([[0.98, 0.0], [-0.41, 0.0], [-0.98, 0.0]])
    text = str(made(tug(1.4, 0.4), end, clock="round", messages=12345, floats_sent=24690))
    assert "the constraints cannot all hold" in text
    assert "infeasible: proven" in text
    assert "not at the end of the run" in text
    assert "59 rounds, 12,345 messages, 24,690 numbers sent" in text
    assert "  binding         a2: near(a3) 0.4" in text


@pytest.mark.parametrize("status", words.STATUS)
@pytest.mark.parametrize("verdict", words.VERDICT)
def test_words_bear_what_is_missing(status: str, verdict: str) -> None:
    free = cs.Team([cs.Agent("a"), cs.Agent("b", [cs.within([0, 0], 1)])], links="complete")
    changes: dict[str, Any] = {
        "margin": None,
        "smooth_margin": None,
        "bounds": [None, None],
        "satisfied_from": {"time": None, "round": None},
    }
    text = words.summary(made(free, np.zeros((2, 2)), status=status, verdict=verdict, **changes).summary)
    assert "margin          none" in text
    assert "a  (0, 0)  no constraints" in text
    huge = words.summary(made(free, np.zeros((2, 2)), positions=None, agents=None, clusters=None, count=12000).summary)
    assert "12,000, too many to list" in huge


def test_of_many_agents_the_tightest_are_named() -> None:
    team, end = PAGES["crowd"]
    end = end + np.stack([np.zeros(20), np.arange(20) == 13], axis=1) * 0.9
    text = str(made(team, end))
    assert "20; the tightest: q13 (0.19), " in text
    assert len(text.splitlines()) < 12


def test_views_load_no_matplotlib_before_a_figure_is_asked_for() -> None:
    code = "import sys, consat.views, consat.views.words; print('matplotlib' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


# ---- constraints that move


def escort(count: int = 2, dimension: int = 2) -> Result:
    """A goal that goes from -4 to 4 in 10 s, beside a keep-out that stays, in a run of 20 rounds that takes 10 s."""
    way = cs.schedule([0, 10], [[-4.0, *[0.0] * (dimension - 1)], [4.0, *[0.0] * (dimension - 1)]])
    agents = [cs.Agent(f"m{i}", [cs.within(way, 1), cs.outside([0.0] * dimension, 0.5)]) for i in range(count)]
    team = cs.Team(agents, links="line", dimension=dimension)
    end = np.zeros((count, dimension))
    end[:, 0] = 4.0
    verdicts = [{"from": 0.0, "to": 10.0, "verdict": "feasible", "bounds": [1.0, 1.0]}]
    flat = made(team.at(10.0), end, clock="round", samples=21, copies=False, verdicts=verdicts)
    return Result(flat.summary, flat.data, team=team)


@pytest.mark.parametrize("count", [2, 20])
def test_a_goal_that_moves_is_drawn_where_it_is(count: int) -> None:
    shown = scene.Scene(escort(count))
    for moment, middle in ((0.0, -4.0), (10.0, 0.0), (20.0, 4.0)):
        shown.show(moment)
        [region] = shadings(shown.figure)
        low, high = region.get_path().vertices.min(axis=0), region.get_path().vertices.max(axis=0)
        assert (low + high) / 2 == pytest.approx([middle, 0], abs=0.1)
        [bar] = patches(shown.figure, "keep-out")
        assert bar.get_path().contains_point((0, 0.3))


def test_a_goal_that_moves_is_drawn_where_it_is_in_space() -> None:
    shown = scene.Scene(escort(2, 3))
    for moment, middle in ((0.0, -4.0), (10.0, 0.0), (20.0, 4.0)):
        shown.show(moment)
        drawn(shown.figure)
        rings = [np.concatenate(lines._segments3d) for lines in named(shown.figure, "boundary")]
        assert len(rings) == 2
        centers = [(ring.min(axis=0) + ring.max(axis=0))[0] / 2 for ring in rings]
        assert centers == pytest.approx([0.0, middle])
