"""Robots, obstacles and verdicts over time are drawn where they are, and said as they are."""

from __future__ import annotations

import base64
from typing import Any

import numpy as np
import pytest
from matplotlib.collections import EllipseCollection
from matplotlib.patches import Rectangle

import consat as cs
from consat.results.result import Result
from consat.views import figures, replay, scene, words
from tests.unit.test_views import GREETING, made, tug

UNICYCLE = {"kind": "unicycle", "radius": 0.2, "speed": 0.5, "turn_rate": 3.6, "offset": 0.05}
OBSTACLES = [
    {"kind": "disc", "center": [0.0, 3.0], "radius": 0.5},
    {"kind": "box", "low": [-1.0, -3.5], "high": [1.0, -3.0]},
    {"kind": "polygon", "vertices": [[3.0, 2.0], [4.0, 2.0], [3.0, 3.0]]},
]
MOTION = {
    "duration": 30.0, "satisfied_share": 0.5, "satisfied_share_after": 0.99, "worst_margin_after": -0.02,
    "smallest_distance": 0.05, "clearance": 0.03, "contacts": 0, "stuck": ["a1", "a3"],
}  # fmt: skip
VERDICTS = [
    {"from": 0.0, "to": 12.0, "verdict": "feasible", "bounds": [0.1, None]},
    {"from": 12.0, "to": 12.1, "verdict": "undecided", "bounds": [None, None]},
    {"from": 12.1, "to": 30.0, "verdict": "infeasible", "bounds": [None, -0.3]},
]
END = np.pi / 2


def driven(team: cs.Team, end: np.ndarray, **changes: Any) -> Result:
    """A run that never was, of robots that turn from 3 rad to -3 rad, the short way, and then to `END`."""
    own = {"own": {team.ids[0]: {**UNICYCLE, "radius": 0.4, "offset": 0.1}}}
    told = {"robots": UNICYCLE | own, "obstacles": OBSTACLES, "motion": MOTION, "rounds": 59}
    result = made(team, end, "round", copies=False, spread=0.5, **(told | changes))
    heading = np.full((60, team.count), END)
    heading[0], heading[1] = 3.0, -3.0
    data = result.data.assign(heading=(("round", "agent"), heading))
    return Result(result.summary, data, team=team)


@pytest.mark.parametrize("crowd", [False, True], ids=["few", "crowd"])
def test_bodies_have_their_true_size_and_are_behind_the_positions(crowd: bool) -> None:
    team, end = tug(), GREETING
    if crowd:
        team = cs.Team([cs.Agent(f"q{k}", [cs.within([k, 0], 1)]) for k in range(20)])
        end = np.stack([np.arange(20.0), np.zeros(20)], axis=1)
    result = driven(team, end)
    shown = scene.Scene(result, fine=41)
    shown.show(shown.last)
    [discs] = [each for each in shown.axes.collections if isinstance(each, EllipseCollection) and each.get_gid() == "body"]
    radius, offset = np.full(team.count, 0.2), np.full(team.count, 0.05)
    radius[0], offset[0] = 0.4, 0.1
    np.testing.assert_allclose(discs.get_widths(), 2 * radius)
    np.testing.assert_allclose(discs.get_offsets(), end - offset[:, None] * [0.0, 1.0], atol=1e-12)
    [strokes] = [line for line in shown.axes.lines if line.get_gid() == "heading"]
    np.testing.assert_allclose(strokes.get_ydata()[1::3] - strokes.get_ydata()[::3], radius)
    shown.show(0.5)  # half way between two headings the short way round it looks along -x, or nearly
    assert np.all(strokes.get_xdata()[1::3] - strokes.get_xdata()[::3] == pytest.approx(-radius))


def test_obstacles_are_solid_and_seen_and_keep_outs_are_hatched() -> None:
    team = cs.Team([*tug().agents[:2], cs.Agent("a3", [cs.within([-2, 0], 1), cs.outside([-2.5, 0.5], 0.2)])])
    figure = figures.formation(driven(team, GREETING))
    assert figure is not None
    axes = figure.axes[0]
    solid = [patch for patch in axes.patches if patch.get_gid() == "obstacle"]
    assert len(solid) == 3
    assert all(patch.get_fill() and patch.get_hatch() is None and patch.get_facecolor()[3] == 1.0 for patch in solid)
    np.testing.assert_allclose(solid[0].get_path().get_extents().bounds, (-0.5, 2.5, 1.0, 1.0), atol=1e-2)
    np.testing.assert_allclose(solid[1].get_path().get_extents().bounds, (-1.0, -3.5, 2.0, 0.5))
    for patch in solid:
        inside = patch.get_path().get_extents().corners()
        assert np.all(inside > [axes.get_xlim()[0], axes.get_ylim()[0]])
        assert np.all(inside < [axes.get_xlim()[1], axes.get_ylim()[1]])
    assert any(patch.get_hatch() for patch in axes.patches if patch.get_gid() == "keep-out")
    texts = [text.get_text() for text in axes.get_legend().get_texts()]
    assert {"obstacle", "body, and where it looks"} <= set(texts)
    assert "t = 30 s" in axes.get_title()


def test_robots_in_space_are_balls_among_solid_obstacles() -> None:
    team = cs.Team([cs.Agent("a", [cs.within([0, 0, 1], 1)]), cs.Agent("b", [cs.near("a", 2)])], dimension=3)
    obstacles = [{"kind": "disc", "center": [1, 1, 1], "radius": 0.5}, {"kind": "box", "low": [-2, -2, 0], "high": [-1, -1, 2]}]
    quadrotor = {"kind": "quadrotor", "radius": 0.2}
    result = made(
        team, np.array([[0.0, 0, 1], [0.5, 0.5, 1]]), "round", copies=False, robots=quadrotor, obstacles=obstacles, motion=MOTION
    )  # fmt: skip
    figure = figures.formation(result)
    assert figure is not None
    names = [each.get_gid() for each in figure.axes[0].collections]
    assert names.count("obstacle") == 2
    assert names.count("body") == 2
    told = replay.document(result)
    assert told["bodies"] == {"radius": [0.2, 0.2], "offset": [0.0, 0.0], "heading": None}


def test_verdicts_are_a_band_under_the_margin() -> None:
    figure = figures.margins(driven(tug(), GREETING, verdicts=VERDICTS))
    axes = figure.axes[0]
    assert axes.get_xlabel() == "time t [s]"
    [band] = axes.child_axes
    spans = {str(patch.get_gid()): patch for patch in band.patches if isinstance(patch, Rectangle)}
    for each in VERDICTS:
        span = spans[f"verdict {each['verdict']}"]
        assert (span.get_x(), span.get_x() + span.get_width()) == pytest.approx((each["from"], each["to"]))
    assert len({(span.get_facecolor(), span.get_hatch()) for span in spans.values()}) == 3
    assert [text.get_text() for text in band.texts] == ["feasible", "infeasible"]  # the third has no room
    legend = [text.get_text() for text in figure.legends[0].get_texts()]
    assert "the constraints: undecided" in legend
    assert not any("best possible" in text for text in legend)  # at the end only, so it is not drawn over all the time


def test_words_say_how_the_team_kept_up_and_what_bodies_did() -> None:
    summary = driven(tug(), GREETING, verdicts=VERDICTS).summary
    text = words.summary(summary)
    assert "feasible from 0 to 12 s; infeasible from 12.1 to 30 s" in text
    assert "every constraint held for 99 % of the time after t = 15.1 s; worst margin -0.02" in text
    assert "nobody touched; 0.05 m apart at least, 0.03 m from obstacles; stuck: a1, a3" in text
    still = words.summary(summary | {"verdicts": None, "robots": None})
    assert "kept up" not in still
    assert "bodies" not in still
    never = MOTION | {"satisfied_share": 0.0, "satisfied_share_after": None, "worst_margin_after": None, "contacts": 1, "stuck": []}
    text = words.summary(summary | {"motion": never})
    assert "never" in text
    assert "1 pair touched" in text
    assert "stuck" not in text


def test_the_page_holds_bodies_obstacles_and_verdicts() -> None:
    told = replay.document(driven(tug(), GREETING, verdicts=VERDICTS))
    assert told["bodies"]["radius"] == [0.4, 0.2, 0.2]
    heading = np.frombuffer(base64.b64decode(told["bodies"]["heading"]), dtype="<f4").reshape(-1, 3)
    np.testing.assert_allclose(heading[[0, -1]], [[3.0] * 3, [END] * 3], rtol=1e-6)
    assert told["obstacles"] == OBSTACLES
    assert told["verdicts"][0] == [0.0, 12.0, "feasible"]
    assert told["clock"] == "time"
    assert np.frombuffer(base64.b64decode(told["steps"]), dtype="<f4")[-1] == pytest.approx(30.0)


def test_who_joined_later_was_nowhere_before() -> None:
    result = driven(tug(), GREETING)
    result.data["position"].values[:20, 2] = np.nan
    figure = figures.formation(result)
    assert figure is not None
    assert np.isfinite([*figure.axes[0].get_xlim(), *figure.axes[0].get_ylim()]).all()
    replay.page(result)
