"""Sweeps: every run of a batch is the run that it would be by itself, and what is told of them all is true."""

from __future__ import annotations

import csv
import json
import subprocess
import sysconfig
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import consat as cs
from consat.errors import InvalidScenario, InvalidSettings
from consat.runs.sweeping import values
from consat.views import sweeps

CONSAT = Path(sysconfig.get_path("scripts")) / "consat"
ALIKE = ("status", "verdict", "ending", "rounds", "messages", "floats_sent")


def check_against_single(row: dict[str, Any], single: dict[str, Any]) -> None:
    """Rounds and counts are equal, numbers to what is left of rounding after so many rounds of a contracting iteration."""
    assert {name: row[name] for name in ALIKE} == {name: single[name] for name in ALIKE}
    assert row["satisfied_from"] == single["satisfied_from"]["round"]
    assert row["margin"] == pytest.approx(single["margin"], rel=1e-9, abs=1e-9)
    assert row["smooth_margin"] == pytest.approx(single["smooth_margin"], rel=1e-9, abs=1e-9)


def test_runs_of_a_batch_are_those_that_they_are_by_themselves() -> None:
    over = {"loss": [0.0, 0.3], "agents.a2.constraints.0.radius": [1.2, 1.7, 3.0]}
    found = cs.sweep("case-c", over, seeds=4, sleep=0.1, protocol="admm")
    assert len(found.runs) == 24
    for row in found.runs:
        scenario = cs.load("case-c", [f"agents.a2.constraints.0.radius={row['agents.a2.constraints.0.radius']}"])
        check_against_single(row, cs.run(scenario, seed=row["seed"], loss=row["loss"], sleep=0.1, protocol="admm").summary)
    # some of each kind: a reach of 1.2 is infeasible, and admm ends at the best smooth margin, which is not the best margin
    assert {row["status"] for row in found.runs} == {"satisfied", "not-converged"}


@pytest.mark.parametrize(
    ("path", "options"),
    [("protocol.penalty", [1.0, 10.0]), ("start.box", [[-4, 4], [-100, 100]]), ("smoothing", [{"nu_alpha": 3, "nu_beta": 8}, "auto"])],
    ids=["gain", "start", "smoothing"],
)
def test_parameters_of_every_kind(path: str, options: list[Any]) -> None:
    found = cs.sweep("case-b", {path: options}, seeds=[7, 3], protocol="admm")
    assert [row["seed"] for row in found.runs] == [7, 3, 7, 3]
    for row in found.runs:
        scenario = cs.load("case-b", [f"{path}={json.dumps(row[path])}"])
        check_against_single(row, cs.run(scenario, seed=row["seed"], protocol="admm").summary)
    assert found.runs[0]["margin"] != found.runs[2]["margin"]


def test_shapes_may_differ_and_flows_take_part() -> None:
    names = ["agents.a3.constraints.0.center"]
    apart = cs.sweep("case-b", {names[0]: [[-2, 0], [-9, 0]]}, seeds=2, rounds=20)
    assert [row["rounds"] for row in apart.runs] == [20] * 4
    assert [group["success"] for group in apart.summary["groups"]] == [1.0, 0.0]
    flows = cs.sweep("case-a", {"start.box": [[-1, 1], [-4, 4]]}, protocol="gradient-flow", until=12.0)
    single = cs.run(cs.load("case-a", ["start.box=[-4, 4]"]), protocol="gradient-flow", until=12.0).summary
    assert flows.runs[1]["margin"] == single["margin"]
    assert flows.runs[1]["satisfied_from"] == single["satisfied_from"]["time"]


def test_mean_and_spread_are_those_of_the_runs() -> None:
    found = cs.sweep("case-c", seeds=50, loss=0.2)
    [group] = found.summary["groups"]
    since = [row["satisfied_from"] for row in found.runs]
    assert group["satisfied_from"]["mean"] == pytest.approx(np.mean(since))
    assert group["satisfied_from"]["std"] == pytest.approx(np.std(since))
    assert (group["satisfied_from"]["min"], group["satisfied_from"]["max"]) == (min(since), max(since))
    assert group["success"] == np.mean([row["status"] == "satisfied" for row in found.runs])
    assert found.summary["seeds"] == [0, 50]
    assert "50 runs" in str(found)


def test_more_runs_than_places_in_the_pool(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("consat.engine.batch.LANES", 4)
    few = cs.sweep("case-c", seeds=11, loss=0.3)
    monkeypatch.undo()
    many = cs.sweep("case-c", seeds=11, loss=0.3)
    for one, two in zip(few.runs, many.runs, strict=True):
        assert {name: one[name] for name in ALIKE} == {name: two[name] for name in ALIKE}
        assert one["margin"] == pytest.approx(two["margin"], abs=1e-9)


def test_values_are_lists_or_ranges() -> None:
    assert values("0.5:2:4") == [0.5, 1.0, 1.5, 2.0]
    assert values("1,2.5,x") == [1, 2.5, "x"]
    assert values("[-4, 4],[-9, 9]") == [[-4, 4], [-9, 9]]
    assert values("{from: 0.01, to: 5, rate: 1},5") == [{"from": 0.01, "to": 5, "rate": 1}, 5]
    with pytest.raises(InvalidSettings, match="FROM:TO:COUNT"):
        values("a:b:c")


def test_wrong_input_is_told() -> None:
    with pytest.raises(InvalidScenario, match="no entry 'a9'"):
        cs.sweep("case-c", {"agents.a9.start": [1]})
    with pytest.raises(InvalidSettings, match="a probability below 1"):
        cs.sweep("case-c", {"loss": [1.5]})
    with pytest.raises(InvalidSettings, match="no values"):
        cs.sweep("case-c", {"loss": []})
    with pytest.raises(InvalidSettings, match="no seeds"):
        cs.sweep("case-c", seeds=0)


def test_figure_counts_seeds_that_do_not_follow_each_other() -> None:
    found = cs.sweep("case-b", seeds=[3, 7])
    assert ", 2 seeds" in sweeps.draw(found.summary, found.runs).axes[0].get_title()


def test_command_writes_table_csv_json_and_figure(tmp_path: Path) -> None:
    command = [CONSAT, "sweep", "case-c", "--over", "loss=0,0.4", "--over", "agents.a2.constraints.0.radius=1.5:3:3", "--seeds", "5"]
    done = subprocess.run([*command, "--seed", "2", "--out", tmp_path], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "rounds to satisfaction" in done.stdout
    rows = list(csv.DictReader((tmp_path / "sweep.csv").read_text().splitlines()))
    assert (len(rows), rows[0]["seed"], rows[0]["status"]) == (30, "2", "satisfied")
    summary = json.loads((tmp_path / "sweep.json").read_text())
    assert (summary["schema"], summary["count"], len(summary["groups"])) == ("consat.sweep/1", 30, 6)
    with Image.open(tmp_path / "sweep.png") as picture:
        assert picture.size[0] > 800
    wrong = subprocess.run([CONSAT, "sweep", "case-c", "--over", "loss"], capture_output=True, text=True, check=False)
    assert wrong.returncode == 2
    assert "PATH=VALUES" in wrong.stderr
