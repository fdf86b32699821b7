"""What a page may ask for: bounded, strict, and never more than a refusal in words."""

from __future__ import annotations

import asyncio
import json
import random
import struct
import threading
import time
from typing import Any

import numpy as np
import pytest

from consat.errors import InvalidSettings
from consat.server import frames, orders
from consat.server.app import Host, Watcher
from consat.server.background import Background
from consat.server.board import Board
from consat.server.client import Allowance

GOOD: list[dict[str, Any]] = [
    {"do": "change", "agent": "a", "constraint": "goal", "parameters": {"center": [3, 1.5], "radius": 2}, "id": 1, "gesture": 4},
    {"do": "shape", "scene": 1, "shape": 0, "center": [1, 2]},
    {"do": "shape", "scene": 1, "shape": 0, "radius": 0.5},
    {"do": "wall", "scene": 1, "wall": 0, "offset": -2},
    {"do": "place", "agent": "a", "position": [1, 2]},
    {"do": "add", "agent": "c", "position": [0, 0], "constraints": [{"kind": "near", "agent": "a", "radius": 2}], "links": ["a"]},
    {"do": "remove", "agent": "a"},
    {"do": "kill", "agent": "a"},
    {"do": "revive", "agent": "a"},
    {"do": "connect", "one": "a", "other": "b"},
    {"do": "disconnect", "one": "a", "other": "b"},
    {"do": "add_constraint", "agent": "a", "constraint": {"kind": "expr", "psi": "1 - norm2(a)"}},
    {"do": "remove_constraint", "agent": "a", "constraint": "goal"},
    {"do": "step"},
    {"do": "step", "rounds": 10},
    {"do": "speed", "rounds": 50},
    {"do": "loss", "share": 0.3},
    {"do": "protocol", "kind": "admm"},
    {"do": "pause"},
]


@pytest.mark.parametrize("order", GOOD, ids=lambda order: order["do"])
def test_orders_are_read(order: dict[str, Any]) -> None:
    assert orders.parse(json.dumps(order)).model_dump(exclude_unset=True) == order


@pytest.mark.parametrize(
    ("raw", "words"),
    [
        ("", "message: "),
        ("{", "message: "),
        ("[]", "message: "),
        ('{"do": "destroy"}', "message: .*'destroy'"),
        ('{"agent": "a"}', "message: unable to extract tag using discriminator 'do'"),
        ('{"do": "kill"}', "agent: field required"),
        ('{"do": "kill", "agent": 7}', "agent: input should be a valid string; it is 7"),
        ('{"do": "kill", "agent": "a", "now": 1}', "now: extra inputs are not permitted"),
        ('{"do": "speed", "rounds": 1e9}', "rounds: input should be less than or equal to 1000"),
        ('{"do": "speed", "rounds": NaN}', "message: |rounds: "),
        ('{"do": "place", "agent": "a", "position": [1e999, 0]}', "position.*: |message: "),
        ('{"do": "step", "rounds": 100000}', "rounds: input should be less than or equal to 1000"),
        ('{"do": "loss", "share": 1}', "share: input should be less than 1"),
        ('{"do": "change", "agent": "a", "constraint": "goal", "parameters": {"center": {"a": 1}}}', "parameters.center"),
        ("[" * 4000, "message: "),
        ('{"do": "kill", "agent": "' + "a" * 5000 + '"}', "the message has 5,0.. bytes, but may have at most 4,096"),
    ],
)
def test_bad_orders_are_refused_in_words(raw: str, words: str) -> None:
    with pytest.raises(InvalidSettings, match=words) as caught:
        orders.parse(raw)
    assert len(str(caught.value)) < 500
    assert "\n" not in str(caught.value)


def garbled(random_: random.Random) -> str | bytes:
    """A message that may be anything, mostly nearly an order."""
    order: Any = json.loads(json.dumps(random_.choice(GOOD)))
    for _ in range(random_.randrange(4)):
        key = random_.choice([*order, "do", "x", "__class__"])
        order[key] = random_.choice(
            [None, True, -1, 0.5, 2**70, 1e308, "", "a" * 50, [], [1, "2"], [[1]], {}, {"kind": "within"}, "\ud800"]
        )
    text = json.dumps(order)
    if random_.random() < 0.3:
        k = random_.randrange(len(text))
        text = text[:k] + random_.choice(["", '"', "{", "]", "\\", "1e999", "NaN", "\x00", "é"]) + text[k + random_.randrange(3) :]
    return bytes(random_.randrange(256) for _ in range(random_.randrange(60))) if random_.random() < 0.05 else text


def test_fuzz_of_messages() -> None:
    random_, read, longest = random.Random(18), 0, 0  # noqa: S311
    for _ in range(5000):
        raw = garbled(random_)
        try:
            orders.parse(raw)
            read += 1
        except InvalidSettings as error:
            longest = max(longest, len(str(error)))
        number = orders.number_of(raw)
        assert number is None or 0 <= number < 2**53
    assert longest < 500
    assert 500 < read < 4500  # both ways are tried


def test_frames_are_16_bytes_and_float32() -> None:
    x, margins = np.arange(6.0).reshape(3, 2), np.array([0.5, -1.0, np.inf])
    raw = frames.packed(7, 2**33 + 5, -1.0, x, margins)
    assert struct.unpack("<BBHIfI", raw[:16]) == (1, 2, 0, 5, -1.0, 7)
    assert len(raw) == 16 + 3 * 12
    np.testing.assert_array_equal(np.frombuffer(raw, "<f4", offset=16), np.concatenate([x.ravel(), margins]).astype("<f4"))
    turned = frames.packed(7, 0, np.inf, np.zeros((3, 5)), margins, np.ones(3))
    assert struct.unpack("<BBH", turned[:4]) == (1, 3, 1)
    assert len(turned) == 16 + 3 * 20


def test_board_keeps_only_the_newest() -> None:
    board, seen = Board(), dict[str, int]()
    for k in range(1000):
        board.put("frame", str(k).encode())
        board.put("scene", str(k))
    assert list(board.news(seen)) == ["999", b"999"]
    assert list(board.news(seen)) == []
    board.put("frame", b"new")
    assert list(board.news(seen)) == [b"new"]


class Slow:
    """A socket that takes nothing until it is told."""

    def __init__(self) -> None:
        self.ready, self.sent = asyncio.Event(), list[bytes]()

    async def send_bytes(self, content: bytes) -> None:
        await self.ready.wait()
        self.sent.append(content)


class Silent:
    """A simulation of which only the board counts."""

    alive, name = True, "silent"

    def __init__(self) -> None:
        self.board = Board()


def test_slow_client_gets_the_newest_and_nothing_is_kept_for_it() -> None:
    async def hour() -> list[bytes]:
        simulation, socket = Silent(), Slow()
        host, client = Host(simulation), Watcher(0, simulation, asyncio.get_running_loop())  # type: ignore[arg-type]
        sending = asyncio.create_task(host._send(socket, client))  # type: ignore[arg-type]
        for k in range(60 * 60 * 60):  # at 60 a second
            simulation.board.put("frame", b"%d" % k)
            client.came.set()
            if k % 1000 == 0:
                await asyncio.sleep(0)
        for k in range(1000):
            client.answer({"k": k})
        assert len(client.answers) == 64
        client.answers.clear()
        socket.ready.set()
        await asyncio.sleep(0.05)
        sending.cancel()
        return socket.sent

    assert asyncio.run(hour()) == [b"0", b"215999"]


def test_allowance_refills() -> None:
    allowance = Allowance(rate=50.0, burst=5.0)
    assert [allowance.take() for _ in range(7)] == [True] * 5 + [False] * 2
    time.sleep(0.05)
    assert allowance.take()


def test_background_does_the_newest() -> None:
    done, over = list[int](), threading.Event()

    def work(task: int) -> None:
        done.append(task)
        over.set()

    background = Background(work, 0.05, 1.0, "test")
    for k in range(100):
        background.ask(k)
    assert over.wait(5.0)
    background.close()
    assert done == [99]
