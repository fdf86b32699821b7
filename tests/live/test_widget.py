"""The view in a notebook: a comm carries its messages, and keeps nothing for a view that is slow or gone."""

from __future__ import annotations

import json
import sys
import threading
import time
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import pytest

import consat as cs
from consat.server import handle, widget
from consat.server.frames import HEADER
from consat.server.widget import MOST_UNTAKEN, LiveWidget
from tests.live.conftest import pair


class Comm:
    """A notebook's comm, of which the other end is a list."""

    def __init__(self) -> None:
        self.sent: list[tuple[dict[str, Any], list[bytes]]] = []
        self.came = threading.Condition()

    def send(self, data: dict[str, Any], buffers: list[bytes]) -> None:
        with self.came:
            self.sent.append((data["content"], buffers))
            self.came.notify_all()


def message(content: Any) -> dict[str, Any]:
    """What the widget hears when a view sends this."""
    return {"content": {"data": {"method": "custom", "content": content}}, "buffers": []}


class View:
    """What widget.main.ts does, without a browser."""

    def __init__(self, shown: LiveWidget, name: str) -> None:
        self._shown, self.name, self.newest, self._read = shown, name, dict[str, Any](), 0
        self.send(opened=True)

    def send(self, **content: Any) -> None:
        self._shown._handle_msg(message({"view": self.name, **content}))

    def waiting(self) -> list[tuple[dict[str, Any], list[bytes]]]:
        return [each for each in self._shown.comm.sent[self._read :] if each[0]["view"] == self.name]

    def take(self) -> None:
        """Take what has come."""
        waiting, self._read = self.waiting(), len(self._shown.comm.sent)
        for content, buffers in waiting:
            left = list(buffers)
            for text in content["texts"]:
                if text is None:
                    self.newest["frame"] = left.pop(0)
                else:
                    told = json.loads(text)
                    self.newest[told["type"]] = told
            assert not left
            self.send(taken=1)

    def until(self, holds: Callable[[dict[str, Any]], bool], seconds: float = 60.0) -> None:
        end = time.monotonic() + seconds
        while not holds(self.newest):
            assert time.monotonic() < end, self.newest.keys()
            self.take()
            time.sleep(0.01)


@pytest.fixture(scope="module")
def shown() -> Iterator[LiveWidget]:
    with cs.live(pair(), widget=True, seed=1) as found:
        assert isinstance(found, LiveWidget)
        with pytest.MonkeyPatch.context() as patch:  # traitlets check the kind of a comm, duck or not
            patch.setattr(LiveWidget, "comm", Comm())
            yield found
    assert not found.alive
    assert repr(found).endswith("closed>")


def test_view_is_told_the_team_and_its_orders_are_answered(shown: LiveWidget) -> None:
    view = View(shown, "one")
    view.until(lambda newest: {"scene", "state", "frame"} <= newest.keys() and HEADER.unpack(newest["frame"][:16])[3] > 2)
    assert view.newest["scene"]["ids"] == ["a", "b"]
    view.send(order=json.dumps({"do": "place", "agent": "a", "position": [1, 1], "id": 5}))
    view.until(lambda newest: newest.get("answer", {}).get("id") == 5)
    assert view.newest["answer"]["ok"]
    view.send(order='{"do": "destroy"}')
    view.until(lambda newest: not newest["answer"]["ok"])
    view.send(closed=True)


def test_two_views_see_the_same_and_what_is_no_message_is_ignored(shown: LiveWidget) -> None:
    for garbage in (None, [], {"view": 7}, {"view": "x" * 1000}):
        shown._handle_msg(message(garbage))
    one, other = View(shown, "one"), View(shown, "other")
    one.send(order=json.dumps({"do": "pause", "id": 1}))
    for each in (one, other):
        each.until(lambda newest: not newest.get("state", {"playing": True})["playing"] and "frame" in newest)
    assert one.newest["frame"] == other.newest["frame"]
    one.send(order=json.dumps({"do": "play", "id": 2}))
    for each in (one, other):
        each.send(closed=True)
    assert not shown._watchers


def test_slow_view_gets_the_newest_and_nothing_is_kept_for_it(shown: LiveWidget) -> None:
    view, board = View(shown, "slow"), shown._simulation.board
    for k in range(60 * 60 * 60):  # an hour at 60 a second
        board.put("frame", b"%d" % k)
        if k % 1000 == 0:
            shown._tell()
    assert len(view.waiting()) == MOST_UNTAKEN
    view.send(closed=True)


def test_view_that_is_gone_is_forgotten_and_one_that_was_slow_is_told_all_anew(shown: LiveWidget, monkeypatch: pytest.MonkeyPatch) -> None:
    view = View(shown, "gone")
    monkeypatch.setattr(widget, "PATIENCE", 0.2)
    end = time.monotonic() + 60.0
    while shown._watchers:
        assert time.monotonic() < end
        time.sleep(0.02)
    assert shown._simulation._watched == 0  # the team stands still
    view.newest.clear()
    view.until(lambda newest: {"scene", "state", "frame"} <= newest.keys())
    assert list(shown._watchers) == ["gone"]
    view.send(closed=True)


def test_notebooks_get_the_widget_and_others_the_page(monkeypatch: pytest.MonkeyPatch) -> None:
    assert not handle.in_notebook()
    monkeypatch.setitem(sys.modules, "IPython", SimpleNamespace(get_ipython=lambda: SimpleNamespace(kernel=object())))
    assert handle.in_notebook()
    with cs.live(pair(), port=0, open_page=False, block=False) as served:
        assert served.url.startswith("http://127.0.0.1:")
    monkeypatch.setitem(sys.modules, "IPython", SimpleNamespace(get_ipython=lambda: None))
    assert not handle.in_notebook()
    monkeypatch.setitem(sys.modules, "marimo", SimpleNamespace(running_in_notebook=lambda: True))
    assert handle.in_notebook()
