"""Exports say what the result says: CSV is read as a table, MCAP by mcap's own reader, the data of a page is decoded, films are opened."""

from __future__ import annotations

import base64
import csv
import hashlib
import json
import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import consat as cs
from consat.results.result import Result
from consat.views import export, replay
from tests.unit.test_views import GREETING, made, tug


def courtyard() -> Result:
    """Two agents, an obstacle that they share, a wall, a tie, and a text that no library kind says."""
    agents = [
        cs.Agent("a<1>", [cs.within([2, 0], 1), cs.outside([0, 0], 0.5), cs.halfspace([0, 1], 3)]),
        cs.Agent("a2", [cs.near("a<1>", 2), cs.outside([0, 0], 0.5), cs.expr("4 - a2[0]**2 - 2 * a2[1]**2")]),
        cs.Agent("free"),
    ]
    team = cs.Team(agents, links=[("a<1>", "a2"), ("a2", "free")], unit="m")
    return made(team, np.array([[2.0, 0.0], [1.0, 0.5], [0.0, 2.0]]), samples=8, clock="round")


def test_csv_has_a_row_for_each_agent_at_each_round(tmp_path: Path) -> None:
    result = courtyard()
    path = result.export(tmp_path / "new" / "run.csv")
    rows = list(csv.DictReader(path.read_text(encoding="utf-8").splitlines()))
    assert list(rows[0]) == ["round", "agent", "x", "y", "margin"]
    assert len(rows) == 8 * 3
    x, margins = result.data["position"].values, result.data["agent_margin"].values
    for place, row in enumerate(rows):
        step, agent = divmod(place, 3)
        assert (int(row["round"]), row["agent"]) == (step, ["a<1>", "a2", "free"][agent])
        assert [float(row["x"]), float(row["y"])] == pytest.approx(x[step, agent])
        assert row["margin"] == "" if agent == 2 else float(row["margin"]) == pytest.approx(margins[step, agent])


def test_csv_has_seconds_where_rounds_take_time(tmp_path: Path) -> None:
    result = cs.run("case-b", rate=5.0, until=2.0)
    rows = list(csv.DictReader(result.export(tmp_path / "run.csv").read_text(encoding="utf-8").splitlines()))
    assert list(rows[0]) == ["round", "agent", "time", "x", "y", "margin"]
    assert [float(row["time"]) for row in rows] == pytest.approx([int(row["round"]) / 5.0 for row in rows])


@pytest.mark.parametrize(("name", "said"), [
    ("run.xyz", "run.xyz ends in .xyz, but must end in one of .csv, .gif, .html, .mcap, .mp4"),
    ("run.htm", "run.htm ends in .htm, but must end in one of .csv, .gif, .html, .mcap, .mp4; did you mean '.html'?"),
    ("run", "run has no ending, but must end in one of .csv, .gif, .html, .mcap, .mp4"),
])  # fmt: skip
def test_other_endings_are_refused_with_those_that_there_are(name: str, said: str) -> None:
    with pytest.raises(cs.InvalidSettings) as caught:
        made(tug(), GREETING).export(name)
    assert str(caught.value) == said


@pytest.mark.parametrize(("module", "name", "extra"), [("av", "run.mp4", "video"), ("foxglove", "run.mcap", "mcap")])
def test_a_missing_extra_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, module: str, name: str, extra: str) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(cs.InvalidSettings, match=rf"pip install 'consat\[{extra}\]'"):
        made(tug(), GREETING).export(tmp_path / name)
    assert not list(tmp_path.iterdir())


def test_where_nobody_was_recorded_there_is_nothing_to_export(tmp_path: Path) -> None:
    whole = made(tug(), GREETING)
    bare = Result(whole.summary, whole.data.drop_dims(["agent", "copy"]), team=whole.team)
    for ending in export.FORMATS:
        with pytest.raises(cs.InvalidSettings, match="run with --record all"):
            bare.export(tmp_path / f"run{ending}")


# ---- MCAP


def messages(path: Path) -> dict[str, list[tuple[float, bytes, str]]]:
    """Of each topic its messages as mcap's own reader gives them: time in s, payload, schema."""
    from mcap.reader import make_reader

    found: dict[str, list[tuple[float, bytes, str]]] = {}
    with path.open("rb") as file:
        for schema, channel, message in make_reader(file, validate_crcs=True).iter_messages():
            found.setdefault(channel.topic, []).append((message.log_time / 1e9, message.data, schema.name if schema else ""))
    return found


def fields(data: bytes) -> Iterator[tuple[int, Any]]:
    """Number and value of each field of a protobuf message: whole numbers, or bytes."""

    def whole() -> int:
        nonlocal at
        value = shift = 0
        while True:
            byte = data[at]
            at, value, shift = at + 1, value | (byte & 127) << shift, shift + 7
            if byte < 128:
                return value

    at = 0
    while at < len(data):
        key = whole()
        kind = key & 7
        if kind == 0:
            yield key >> 3, whole()
        else:
            size = {1: 8, 5: 4}.get(kind) or whole()
            yield key >> 3, data[at : at + size]
            at += size


def test_mcap_is_read_back_by_another_reader(tmp_path: Path) -> None:
    result = courtyard()
    found = messages(result.export(tmp_path / "run.mcap"))
    x, margins = result.data["position"].values, result.data["agent_margin"].values
    schemas = {topic: told[0][2] for topic, told in found.items()}
    assert schemas["/agents"] == "foxglove.PointCloud"
    assert schemas["/scene"] == "foxglove.SceneUpdate"
    assert schemas["/tf"] == "foxglove.FrameTransforms"
    for topic, told in found.items():
        assert [time for time, *_ in told] == pytest.approx(np.arange(8) * 0.1), topic
    for k, (_, data, _) in enumerate(found["/agents"]):
        cloud = dict(fields(data))
        assert int.from_bytes(cloud[4], "little") == 16  # point_stride, fixed32
        points = np.frombuffer(cloud[6], "<f4").reshape(3, 4)
        assert points[:, :2] == pytest.approx(x[k], rel=1e-6)
        assert points[:2, 3] == pytest.approx(margins[k, :2], rel=1e-5)
    numbers = [json.loads(data) for _, data, _ in found["/margin"]]
    assert [told["margin"] for told in numbers] == pytest.approx(result.data["margin"].values)
    assert [told["step"] for told in numbers] == list(range(8))
    own = json.loads(found["/agent_margins"][-1][1])
    assert own == pytest.approx({"a<1>": margins[-1, 0], "a2": margins[-1, 1]})


def test_mcap_holds_regions_keep_outs_links_and_names(tmp_path: Path) -> None:
    found = messages(courtyard().export(tmp_path / "run.mcap"))["/scene"]

    def names(data: bytes) -> list[str]:
        return sorted(
            next(value for number, value in fields(entity) if number == 3).decode() for field, entity in fields(data) if field == 2
        )

    first, later = names(found[0][1]), names(found[1][1])
    assert first == ["keep-out 1", "links", "names", "region 0", "region 3", "region 5", "wall 2"]
    assert later == ["links", "names", "region 3"]  # what stands still is told once
    entities = [dict(fields(entity)) for field, entity in fields(found[-1][1]) if field == 2]
    [links] = [dict(fields(entity[11])) for entity in entities if entity[3] == b"links"]
    assert links[1] == 2  # a list of lines: each two points are one


# ---- the page


def data_of(text: str) -> dict[str, Any]:
    found = re.search(r'<script type="application/json" id="run">(.*?)</script>', text, re.DOTALL)
    assert found
    return dict(json.loads(found[1]))


def array(text: str, kind: str = "<f4") -> np.ndarray:
    return np.frombuffer(base64.b64decode(text), kind)


def test_page_holds_what_was_recorded(tmp_path: Path) -> None:
    result = courtyard()
    path = result.html(tmp_path / "page.html")
    data = data_of(path.read_text(encoding="utf-8"))
    assert data["schema"] == "consat.replay/1"
    assert data["ids"] == ["a<1>", "a2", "free"]
    assert (data["unit"], data["clock"], data["dimension"]) == ("m", "round", 2)
    assert array(data["x"]).reshape(8, 3, 2) == pytest.approx(result.data["position"].values, rel=1e-6)
    assert array(data["margin"]) == pytest.approx(result.data["margin"].values, rel=1e-6)
    assert array(data["agent_margin"]).reshape(8, 3)[:, :2] == pytest.approx(result.data["agent_margin"].values[:, :2], rel=1e-5)
    assert array(data["links"], "<i4").reshape(-1, 2).tolist() == [[0, 1], [1, 2]]
    balls = {(tuple(ball["center"]), ball["around"], ball["radius"], ball["out"]): ball["owners"] for ball in data["balls"]}
    assert balls == {((2, 0), -1, 1, False): [0], ((0, 0), -1, 0.5, True): [0, 1], ((0, 0), 0, 2, False): [1]}
    [wall] = data["walls"]
    assert [y for _, y in wall["corners"]] == [3, 3]
    [outline] = data["outlines"]
    [[line]] = outline["lines"]
    px, py = np.array(line).reshape(-1, 2).T
    assert px**2 + 2 * py**2 == pytest.approx(4, abs=0.05)
    assert data["low"][0] < -2 < 3 < data["high"][0]


def test_page_loads_nothing_and_runs_nothing_but_its_own_script() -> None:
    text = replay.page(courtyard())
    assert text.startswith("<!doctype html>")
    assert not re.search(r"\b(src|href)\b *=|url\(|@import|fetch\(|import\(|XMLHttp|WebSocket|eval\(|Function\(|innerHTML", text)
    policy = re.search(r'http-equiv="Content-Security-Policy" content="([^"]+)"', text)
    assert policy
    assert policy[1].startswith("default-src 'none'; ")
    for kind, tag in (("script-src", "script"), ("style-src", "style")):
        [inside] = re.findall(rf"<{tag}>(.*?)</{tag}>", text, re.DOTALL)
        digest = base64.b64encode(hashlib.sha256(inside.encode()).digest()).decode()
        assert f"{kind} 'sha256-{digest}'" in policy[1]
    assert "a<1>" not in text  # names are escaped


def test_of_a_long_record_the_page_replays_some_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(replay, "MOST_NUMBERS", 60)
    data = replay.document(made(tug(), GREETING, samples=50, clock="round"))
    steps = array(data["steps"])
    assert 5 <= len(steps) <= 10
    assert (steps[0], steps[-1]) == (0, 49)
    assert len(array(data["x"])) == 6 * len(steps)


# ---- films


def test_mp4_is_a_video(tmp_path: Path) -> None:
    av = pytest.importorskip("av")
    from consat.views import animation

    path = animation.save(made(tug(), GREETING), tmp_path / "run.mp4", seconds=1.0, fps=10)
    with av.open(str(path)) as film:
        [stream] = film.streams.video
        pictures = [frame.to_ndarray(format="rgb24") for frame in film.decode(stream)]
        assert stream.codec_context.name == "h264"
        assert stream.average_rate == 10
    assert len(pictures) == 10
    assert all(side % 2 == 0 for side in pictures[0].shape[:2])
    assert np.abs(pictures[0].astype(int) - pictures[-1].astype(int)).max() > 100


def test_a_film_of_seven_agents_is_small_and_shows_its_whole_legend(tmp_path: Path) -> None:
    from consat.views import animation

    result = made(cs.load("example-1").team, np.random.default_rng(0).uniform(-2, 2, (7, 2)), samples=20, copies=False)
    path = animation.save(result, tmp_path / "run.gif", seconds=0.3)
    with Image.open(path) as film:
        last = np.asarray(film.convert("L"))
        assert film.n_frames == 3
    assert last[-3:].min() > 240  # nothing reaches the lower edge
    assert last[:, -3:].min() > 240  # nor the right one
    assert path.stat().st_size < 150_000


def test_goals_that_move_are_told_along_their_way(tmp_path: Path) -> None:
    from tests.unit.test_views import escort

    result = escort()
    balls = replay.document(result)["balls"]
    [goal] = [ball for ball in balls if not ball["out"]]
    [bar] = [ball for ball in balls if ball["out"]]
    assert bar["track"] is None
    at, centers = goal["track"]["at"], np.array(goal["track"]["center"])
    assert (at[0], at[-1]) == (0, 20)
    assert centers[:, 0] == pytest.approx(-4 + 0.4 * np.array(at))
    found = messages(result.export(tmp_path / "run.mcap"))["/scene"]
    later = [dict(fields(entity))[3] for field, entity in fields(found[5][1]) if field == 2]
    assert b"region 0" in later
    assert b"keep-out 1" not in later


def wall_on_its_way() -> Result:
    """A wall that moves from x = 2 out of the view, and a side of a box that moves from 3 to 1, in 21 samples."""
    wall = cs.halfspace([1, 0], cs.schedule([0, 300], [2, 500]), name="wall")
    sides = cs.box([-1, -1], cs.schedule([0, 300], [[3, 1], [1, 1]]))
    team = cs.Team([cs.Agent("a", [wall]), cs.Agent("b", [sides])], links=[("a", "b")])
    return made(team, np.array([[0.0, 0.0], [0.0, 0.5]]), samples=21)


def test_half_spaces_that_move_are_told_along_their_way(tmp_path: Path) -> None:
    result = wall_on_its_way()
    walls = {wall["names"][0]: wall for wall in replay.document(result)["walls"]}
    track = walls["wall"]["track"]
    assert track["at"][0] == 0
    assert [corner[0] for corner in track["corners"][0]] == [2, 2]
    assert track["corners"][-1] == []  # it has left the view
    right = walls["box.high[0]"]["track"]
    assert [corners[0][0] for corners in right["corners"]] == pytest.approx(3 - np.array(right["at"]) / 10)
    assert "track" not in walls["box.low[0]"]
    found = messages(result.export(tmp_path / "run.mcap"))["/scene"]
    later = [dict(fields(entity))[3] for field, entity in fields(found[5][1]) if field == 2]
    assert b"wall 0" in later
    assert result.team is not None
    still = list(result.team.names).index("box.low[0]")
    assert f"wall {still}".encode() not in later


def test_mcap_holds_bodies_headings_and_obstacles(tmp_path: Path) -> None:
    team = cs.Team([cs.Agent("a", [cs.within([2, 0], 0.5)], [0, 0]), cs.Agent("b", [cs.within([0, 2], 0.5)], [0, 1])])
    stand = [cs.disc([5, 5], 0.5), cs.polygon([[4, -4], [5, -4], [4, -3]])]
    result = cs.run(team, robots="unicycle", obstacles=stand, rate=10.0, until=3.0)
    found = messages(result.export(tmp_path / "run.mcap"))
    first, last = ([dict(fields(entity)) for field, entity in fields(found["/scene"][k][1]) if field == 2] for k in (0, -1))
    assert {b"obstacle 0", b"obstacle 1", b"bodies"} <= {entity[3] for entity in first}
    assert b"obstacle 0" not in {entity[3] for entity in last}
    assert found["/scene"][-1][0] == pytest.approx(3.0)  # a round takes 0.1 s
    frames = [dict(fields(value)) for field, value in fields(found["/tf"][-1][1]) if field == 1]
    turned = [{field: np.frombuffer(value)[0] for field, value in fields(frame[5])} for frame in frames]
    angles = [2 * np.arctan2(each.get(3, 0.0), each.get(4, 0.0)) for each in turned]
    assert np.cos(angles) == pytest.approx(np.cos(result.data["heading"].values[-1]))
    assert np.sin(angles) == pytest.approx(np.sin(result.data["heading"].values[-1]))


def test_a_film_dwells_on_no_round() -> None:
    from consat.views.record import Record

    shown = Record(cs.run("case-b", rounds=30)).moments(72, 0.75, 0.0625)
    assert (shown[0], shown[-1]) == (0, 30)
    assert np.bincount(shown.astype(int)).max() <= 6
