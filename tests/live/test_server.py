"""The live page's server: who may come in, what orders do, and that a bad one changes nothing."""

from __future__ import annotations

import json
import random
import re
import socket
import sys
import time
import tracemalloc
import urllib.error
import urllib.request
from contextlib import ExitStack
from typing import Any

import pytest
from starlette.testclient import TestClient
from starlette.websockets import WebSocketDisconnect

import consat as cs
from consat.cli import main
from consat.errors import InvalidSettings, NetworkError
from consat.server import handle
from consat.server.app import Host
from consat.server.client import MOST_CLIENTS, Allowance
from tests.live.conftest import SOCKET, Page, pair
from tests.live.test_orders import garbled


def ball(page: Page, agent: str, name: str) -> int:
    scene = page.newest["scene"]
    owner = scene["ids"].index(agent)
    return next(k for k, each in enumerate(scene["balls"]) if owner in each["owners"] and name in each["names"])


def settled(page: Page) -> None:
    page.until(lambda newest: newest.get("verdict", {}).get("verdict") == "feasible" and newest["frame"]["margin"] > 0)


def test_page_allows_only_its_own_script_and_this_machine(client: TestClient) -> None:
    answer = client.get("/")
    assert answer.status_code == 200
    policy = answer.headers["content-security-policy"]
    assert policy.startswith("default-src 'none'; script-src 'sha256-")
    assert "unsafe" not in policy
    assert 'data-part="stage"' in answer.text
    for headers in ({"host": "evil.example"}, {"origin": "http://evil.example"}, {"origin": "null"}, {"host": "[::"}):
        assert client.get("/", headers=headers).status_code == 403
        with pytest.raises(WebSocketDisconnect) as caught, client.websocket_connect(SOCKET, headers=headers):
            pass
        assert caught.value.code == 1008
    with client.websocket_connect(SOCKET, headers={"origin": "http://127.0.0.1:8137"}):
        pass


def test_other_addresses_need_the_token(host: Host) -> None:
    far = Host(host.simulation, "secret")
    client = TestClient(far.app, base_url="http://robot.lan:8137")
    for address in ("/", "/?token=", "/?token=wrong", "/?token=secre\u00e9"):
        assert client.get(address).status_code == 403
        with pytest.raises(WebSocketDisconnect), client.websocket_connect(f"ws://robot.lan:8137/socket{address[1:]}"):
            pass
    assert client.get("/?token=secret").status_code == 200
    host.simulation.notify = host.notify


def test_goal_is_dragged_and_the_team_follows_and_it_is_undone(page: Page) -> None:
    settled(page)
    scene = page.newest["scene"]["number"]
    k = ball(page, "a", "goal")
    for x in (2.1, 2.4, 2.7):
        assert page.send({"do": "shape", "scene": scene, "shape": k, "center": [x, 1], "gesture": 3})["ok"]
    assert page.newest["shapes"]["balls"][str(k)]["center"] == [2.7, 1.0]
    undone = page.newest["state"]["undo"]
    page.until(lambda newest: newest.get("frame", {}).get("margin", 0) > 0)
    assert page.send({"do": "undo"})["ok"]
    assert page.newest["state"]["undo"] == undone - 1  # one gesture is one change
    assert page.newest["shapes"]["balls"][str(k)]["center"] == [2.0, 0.0]


def test_team_torn_apart_says_why(page: Page) -> None:
    assert page.send({"do": "change", "agent": "a", "constraint": "goal", "parameters": {"center": [9, 0]}})["ok"]
    verdict = page.until(lambda newest: newest.get("verdict", {}).get("verdict") == "infeasible")["verdict"]
    assert verdict["bounds"][1] < 0
    assert "cannot all hold" in verdict["reasons"][0]
    assert page.send({"do": "undo"})["ok"]
    settled(page)


def test_killed_agent_comes_back_with_everything(page: Page, host: Host) -> None:
    before = page.send({"do": "text"})["text"]
    assert page.send({"do": "kill", "agent": "a"})["ok"]
    assert page.newest["scene"]["ids"] == ["b"]
    assert list(page.newest["state"]["silent"]) == ["a"]
    assert "last agent" in page.send({"do": "kill", "agent": "b"})["words"]
    assert page.send({"do": "revive", "agent": "a"})["ok"]
    assert page.newest["scene"]["ids"] == ["a", "b"]
    after = cs.loads(page.send({"do": "text"})["text"])
    assert [sorted(after.team.names), after.team.linked] == [sorted(cs.loads(before).team.names), cs.loads(before).team.linked]
    assert page.send({"do": "undo"})["ok"]
    assert page.newest["scene"]["ids"] == ["b"]
    assert page.send({"do": "undo"})["ok"]
    assert page.newest["scene"]["ids"] == ["a", "b"]
    assert page.newest["state"]["silent"] == {}


@pytest.mark.parametrize(
    ("order", "words"),
    [
        ({"do": "kill", "agent": "zz"}, "there is no such agent"),
        ({"do": "revive", "agent": "a"}, "it was not killed"),
        ({"do": "change", "agent": "a", "constraint": "gaol", "parameters": {"radius": 1}}, "did you mean 'goal'"),
        ({"do": "change", "agent": "a", "constraint": "goal", "parameters": {"radius": -1}}, "radius"),
        ({"do": "shape", "scene": 10**6, "shape": 0, "radius": 1}, "the team has changed"),
        ({"do": "place", "agent": "a", "position": [1, 2, 3]}, "position"),
        ({"do": "disconnect", "one": "a", "other": "b"}, "without the link"),
        ({"do": "add", "agent": "c", "position": [0, 0], "constraints": [{"kind": "nere", "agent": "a", "radius": 1}]}, "no kind"),
        ({"do": "add", "agent": "c", "position": [0, 0], "constraints": [{"kind": "near", "agent": "a"}]}, "radius is missing"),
        ({"do": "add", "agent": "c", "position": [0, 0], "constraints": [{"kind": "near", "agents": "a"}]}, "did you mean 'agent'"),
        ({"do": "add_constraint", "agent": "a", "constraint": {"kind": "expr", "psi": "__import__('os')"}}, "import"),
        ({"do": "protocol", "kind": "gradient-flow"}, "flows in continuous time"),
        ({"do": "nonsense"}, "nonsense"),
    ],
    ids=lambda value: value["do"] if isinstance(value, dict) else "",
)
def test_bad_order_changes_nothing(page: Page, order: dict[str, Any], words: str) -> None:
    before = page.send({"do": "text"})["text"].partition("agents:")[2]
    answer = page.send(order)
    assert not answer["ok"]
    assert words in answer["words"]
    assert "Traceback" not in answer["words"]

    def without_starts(text: str) -> str:
        return re.sub(r"start: \[.*\]", "", text)

    assert without_starts(page.send({"do": "text"})["text"].partition("agents:")[2]) == without_starts(before)


def test_pause_step_and_speed(page: Page) -> None:
    assert page.send({"do": "pause"})["ok"]
    assert page.send({"do": "speed", "rounds": 100})["ok"]
    page.send({"do": "text"})
    first = page.newest["frame"]["round"]
    assert page.send({"do": "step", "rounds": 3})["ok"]
    assert page.until(lambda newest: newest["frame"]["round"] > first)["frame"]["round"] == first + 3
    assert page.send({"do": "restart"})["ok"]
    assert page.send({"do": "play"})["ok"]
    page.until(lambda newest: newest["frame"]["round"] > first + 10)
    assert page.newest["state"]["speed"] == 100


def test_two_pages_see_the_same(client: TestClient, page: Page) -> None:
    with client.websocket_connect(SOCKET) as socket:
        other = Page(socket)
        assert page.send({"do": "pause"})["ok"]
        assert page.send({"do": "place", "agent": "a", "position": [1, 1]})["ok"]
        other.until(lambda newest: newest.get("state", {}).get("playing") is False)
        assert page.send({"do": "change", "agent": "b", "constraint": "goal", "parameters": {"radius": 1.25}})["ok"]
        other.until(lambda newest: "shapes" in newest)
        page.send({"do": "text"})
        other.send({"do": "text"})
        assert other.newest["frame"]["bytes"] == page.newest["frame"]["bytes"]
        assert other.newest["shapes"] == page.newest["shapes"]
        assert page.send({"do": "undo"})["ok"]
        assert page.send({"do": "play"})["ok"]


def test_there_is_room_for_so_many(client: TestClient) -> None:
    with ExitStack() as stack:
        for _ in range(MOST_CLIENTS):
            stack.enter_context(client.websocket_connect(SOCKET))
        with pytest.raises(WebSocketDisconnect) as caught, client.websocket_connect(SOCKET):
            pass
        assert caught.value.reason == f"{MOST_CLIENTS} pages watch already"


def test_flood_is_answered_and_the_session_lives(page: Page) -> None:
    for _ in range(600):
        page.socket.send_text("x")
    answers = 0
    words = set()
    while answers < 1 or not any("messages a second" in each for each in words):
        told = page.read()
        if told is not None and told["type"] == "answer":
            answers += 1
            words.add(told["words"])
    time.sleep(0.1)
    assert page.send({"do": "text"})["ok"]


def test_fuzz_of_a_living_session(host: Host, page: Page) -> None:
    random_ = random.Random(7)  # noqa: S311
    client = list(host._clients.values())[-1]
    client.allowance = Allowance(1e9, 1e9)
    compiles = ("add", "remove", "kill", "revive", "connect", "disconnect", "add_constraint", "remove_constraint", "loss", "protocol")
    sent = 0
    while sent < 1500:
        raw = garbled(random_)
        text = raw if isinstance(raw, str) else ""
        if any(f'"{word}"' in text for word in compiles):
            continue
        sent += 1
        if isinstance(raw, bytes) or "\ud800" in raw:
            page.socket.send_bytes(raw if isinstance(raw, bytes) else raw.encode("utf-8", "surrogatepass"))
        else:
            page.socket.send_text(raw)
    client.allowance = Allowance()
    assert page.send({"do": "play"})["ok"]
    assert host.simulation.alive
    assert json.loads(json.dumps(page.newest["state"]))["playing"]


def test_handle_serves_and_closes() -> None:
    page = cs.live(pair(), port=0, open_page=False, block=False, seed=1)
    assert "Live team at http://127.0.0.1:" in repr(page)
    assert b"consat" in urllib.request.urlopen(page.url).read()  # noqa: S310
    with pytest.raises(NetworkError, match=r"nothing can listen on 127\.0\.0\.1, port .*; choose another"):
        cs.live(pair(), port=int(page.url.split(":")[2].strip("/")), open_page=False, block=False)
    page.close()
    assert not page.alive
    with pytest.raises(urllib.error.URLError):
        urllib.request.urlopen(page.url)  # noqa: S310
    with pytest.raises(InvalidSettings, match="port is -1"):
        cs.live(pair(), port=-1)


def test_client_that_reads_nothing_slows_nobody_and_nothing_is_kept_for_it() -> None:
    with (
        cs.live(pair(), port=0, open_page=False, block=False, seed=1) as live,
        socket.create_connection(("127.0.0.1", int(live.url.split(":")[2].strip("/")))) as deaf,
    ):
        deaf.sendall(
            b"GET /socket HTTP/1.1\r\nHost: 127.0.0.1\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
            b"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n"
        )
        simulation = live._simulation
        end = time.monotonic() + 60.0
        while simulation._editor.session.round < 5:  # it watches, so the team goes on
            assert time.monotonic() < end
            time.sleep(0.05)
        tracemalloc.start()
        before, longest = simulation._editor.session.round, 0.0
        for _ in range(2000):  # 400 MB
            begun = time.monotonic()
            simulation.board.put("frame", bytes(200_000))
            simulation.notify()
            longest = max(longest, time.monotonic() - begun)
            time.sleep(0.001)
        kept, _ = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        assert kept < 20_000_000
        assert longest < 1.0
        end = time.monotonic() + 60.0
        while simulation._editor.session.round < before + 20:
            assert time.monotonic() < end
            time.sleep(0.05)


def test_missing_extra_is_one_line(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(handle, "find_spec", lambda name: None)
    monkeypatch.setattr(sys, "argv", ["consat", "live", "case-b"])
    with pytest.raises(SystemExit) as caught:
        main()
    assert caught.value.code == 2
    said = capsys.readouterr().err
    assert "pip install 'consat[live]'" in said
    assert said.count("\n") == 1
    with pytest.raises(InvalidSettings, match=r"pip install 'consat\[notebook\]'"):
        cs.live(pair(), widget=True)
