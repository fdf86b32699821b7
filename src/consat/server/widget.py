"""The live page as a notebook widget: the page in a frame, with messages over the comm of the kernel."""

from __future__ import annotations

import threading
import time
from importlib import resources
from typing import Any, ClassVar, Final, Self

import anywidget
import traitlets

from consat.server.client import MOST_CLIENTS, Client
from consat.server.page import page
from consat.server.simulation import Simulation

MOST_UNTAKEN: Final = 8
"""Most messages on their way to a view. A comm has no limit, and would store all messages for a slow view."""
PATIENCE: Final = 10.0
"""Time after which a view that takes no message is removed, s. If it was only slow, it is added again and receives everything."""


class Watcher(Client):
    """A view of the widget. A widget that is shown twice has two.

    Attributes:
        untaken: number of messages on their way to it.
        since: time at which it last took one, s.
    """

    untaken, since = 0, 0.0


class LiveWidget(anywidget.AnyWidget):
    """A live team in a notebook.

    Each view has a name. It sends ``{view, taken}``, with the number of messages that it took since its last message, and ``opened``,
    ``closed``, or ``order``, an order as text. It receives ``{view, texts}``; a null among the texts stands for the next buffer.

    Args:
        simulation: the team. The constructor starts it.
        height: height of the view, px.
    """

    _esm: ClassVar[Any] = resources.files("consat.views").joinpath("widget.js").read_text(encoding="utf-8")
    page = traitlets.Unicode().tag(sync=True)
    height = traitlets.Int(560).tag(sync=True)

    def __init__(self, simulation: Simulation, height: int = 560) -> None:
        self._simulation, self._lock = simulation, threading.RLock()
        self._watchers: dict[str, Watcher] = {}
        self._numbers = 0
        super().__init__(page=page(simulation.name)[0], height=height)
        self.on_msg(self._heard)
        simulation.notify = self._tell
        simulation.start()

    @property
    def alive(self) -> bool:
        """Whether the session goes on."""
        return self._simulation.alive

    def close(self) -> None:
        """End the session. The view stays as it is at the end."""
        self._simulation.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"<LiveWidget {self._simulation.name}{'' if self.alive else ', closed'}>"

    # ---- what views send, heard by the kernel's thread ----------------------------------------------------------------------------------

    def _heard(self, _: Any, content: Any, __: Any) -> None:
        view = content.get("view") if isinstance(content, dict) else None
        if not isinstance(view, str) or len(view) > 64:
            return
        with self._lock:
            if "closed" in content or "opened" in content:
                self._forget(view)
            if "closed" in content:
                return
            watcher = self._watchers.get(view) or self._open(view)
            if watcher is None:
                return
            taken = content.get("taken")
            if isinstance(taken, int) and taken > 0:
                watcher.untaken, watcher.since = max(0, watcher.untaken - taken), time.monotonic()
            if isinstance(content.get("order"), str):
                watcher.take(content["order"])
        self._tell()

    def _open(self, view: str) -> Watcher | None:
        if len(self._watchers) >= MOST_CLIENTS:
            return None
        self._numbers += 1
        self._watchers[view] = Watcher(self._numbers, self._simulation, self._tell)
        self._simulation.watch(len(self._watchers))
        return self._watchers[view]

    def _forget(self, view: str) -> None:
        if self._watchers.pop(view, None) is not None:
            self._simulation.watch(len(self._watchers))

    # ---- what they are sent, from any thread --------------------------------------------------------------------------------------------

    def _tell(self) -> None:
        with self._lock:
            for view, watcher in list(self._watchers.items()):
                if watcher.untaken >= MOST_UNTAKEN:
                    if time.monotonic() - watcher.since > PATIENCE:
                        self._forget(view)
                    continue
                messages = list(watcher.news())
                if messages:
                    if watcher.untaken == 0:
                        watcher.since = time.monotonic()
                    watcher.untaken += 1
                    texts = [None if isinstance(each, bytes) else each for each in messages]
                    self.send({"view": view, "texts": texts}, [each for each in messages if isinstance(each, bytes)])
