"""What notebooks show: tables with the numbers, pictures that open, names escaped."""

from __future__ import annotations

import base64
import io
import re

import numpy as np
import pytest
from PIL import Image

import consat as cs
from consat.views import notebook
from tests.unit.test_views import GREETING, PAGES, made, tug


def pictures(text: str) -> list[np.ndarray]:
    return [np.asarray(Image.open(io.BytesIO(base64.b64decode(data)))) for data in re.findall(r'src="data:image/png;base64,([^"]+)"', text)]


def rows(text: str) -> list[list[str]]:
    """The cells of all tables."""
    return [re.findall(r"<t[hd][^>]*>(.*?)</t[hd]>", row) for row in re.findall(r"<tr>(.*?)</tr>", text)]


def test_a_result_shows_how_it_ended_and_its_figures() -> None:
    text = made(tug(), GREETING)._repr_html_()
    assert "✓</span> every constraint holds" in text
    told = rows(text)
    assert ["margin", "1"] in told
    assert ["agent", "position", "margin"] in told
    assert ["a2", "(−0.6, 0)", "2.04"] in told
    formation, margin = pictures(text)
    assert formation.std() > 10  # something is drawn
    assert margin.std() > 10


def test_of_a_crowd_the_tightest_are_listed() -> None:
    team, end = PAGES["crowd"]
    end = end + np.stack([np.zeros(20), np.arange(20) == 13], axis=1) * 0.9
    text = made(team, end)._repr_html_()
    told = rows(text)
    first = told[told.index(["tightest", "position", "margin"]) + 1]
    assert first == ["q13", "(13, 0.9)", "0.19"]
    assert "… and 10 more" in text


def test_a_team_shows_its_constraints_and_a_picture() -> None:
    text = cs.Team([cs.Agent("<a>", [cs.within([0, 0], 1, name="x & y")], start=[1, 2]), cs.Agent("b")], unit="m")._repr_html_()
    assert "2 agents, 1 constraint, 0 links, dimension 2, lengths in m" in text
    assert ["&lt;a&gt;", "x &amp; y", "(1, 2)"] in rows(text)
    assert ["b", "none", "drawn"] in rows(text)
    assert len(pictures(text)) == 1
    assert not pictures(cs.Team([cs.Agent("a", [cs.within([0], 1)])], dimension=1)._repr_html_())


def test_agents_without_a_place_stand_on_a_circle() -> None:
    known, unknown = notebook.sketch(cs.Team([cs.Agent("a", [cs.within([5, 0], 1)])])), notebook.sketch(tug())
    assert known is not None
    assert unknown is not None
    assert known.axes[0].lines[-1].get_xydata().tolist() == [[5, 0]]
    assert known.axes[0].get_xlabel() == "position x"
    ends = np.concatenate([line.get_xydata() for line in unknown.axes[0].lines[1:]])
    assert np.hypot(*ends.T) == pytest.approx(1.0)
    assert not unknown.axes[0].axison


def test_a_solution_is_a_dictionary_with_attributes_and_a_table() -> None:
    answer = cs.solve("case-d")
    assert answer["schema"] == "consat.solve/1"
    assert (answer.margin, list(answer.bounds), answer.verdict) == (answer["margin"], answer["bounds"], "infeasible")
    assert answer.positions is answer["positions"]
    assert answer.reasons == answer["reasons"]
    text = answer._repr_html_()
    assert "✗</span> infeasible" in text
    assert ["agent", "position", "binds, with its multiplier"] in rows(text)
    assert any(cells[0] == "a2" and cells[2].startswith("near(a3) 0.4") for cells in rows(text))
    assert len(pictures(text)) == 1


def test_a_sweep_shows_a_row_for_each_value() -> None:
    spread = {"count": 2, "mean": 3.0, "std": 1.0, "min": 2.0, "10 %": 2.1, "median": 3.0, "90 %": 3.9, "max": 4.0}
    measured = {"satisfied_from": spread, "margin": spread, "messages": spread}
    groups = [{"values": {"loss": loss}, "runs": 2, "success": 1 - loss, **measured} for loss in (0.0, 0.5)]
    runs = [{"loss": loss, "seed": seed, "satisfied_from": 3, "margin": 1.0} for loss in (0.0, 0.5) for seed in (0, 1)]
    summary = {
        "schema": "consat.sweep/1", "scenario": "case-b", "protocol": "admm", "estimates": "local", "seeds": [0, 2],
        "over": {"loss": [0.0, 0.5]}, "count": 4, "groups": groups, "runs": runs, "seconds": 1.0,
    }  # fmt: skip
    text = cs.Sweep(summary, runs)._repr_html_()
    told = rows(text)
    assert told[0] == ["loss", "satisfied", "rounds to satisfaction", "margin"]
    assert told[1] == ["0.0", "100% of 2", "3 (2.1 to 3.9)", "3 (2.1 to 3.9)"]
    assert told[2][1] == "50% of 2"
    assert "✗</span> 4 runs of admm" in text
    assert len(pictures(text)) == 1
