"""A session in its own thread: it steps at its pace and takes orders between two rounds."""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Any, Final, NamedTuple

import numpy as np

from consat.errors import ConsatError
from consat.problem.team import Team
from consat.protocols import ROUNDS
from consat.runs.preparation import scenario_of
from consat.scenario import Scenario
from consat.server import orders
from consat.server.board import Board
from consat.server.editor import Editor
from consat.server.orders import Order

SPEED: Final = 20.0
"""Rounds per second at first."""
FRAMES: Final = 60.0
"""Most frames per second."""
MOST_PENDING: Final = 256
"""Most orders that wait."""

Answer = Callable[[dict[str, Any]], None]


class Pending(NamedTuple):
    """An order that waits.

    Attributes:
        order: the order.
        client: number of the client that gave it.
        answer: receives the answer.
    """

    order: Order
    client: int
    answer: Answer

    @property
    def key(self) -> tuple[Any, ...] | None:
        """Orders with the same key replace each other; None if the order replaces no other."""
        subject = self.order.subject
        return None if subject is None else (self.client, self.order.gesture, *subject)


class Simulation:
    """A team that steps and changes while people watch.

    Args:
        team: a `consat.Team`, a scenario, or the name of one.
        settings: arguments of the session, such as ``protocol`` and ``seed``; see `consat.Session`.

    Attributes:
        name: name of the scenario.
        notify: called when the board has news, from other threads.

    Raises:
        ConsatError: as `consat.Session`.
    """

    def __init__(self, team: Team | Scenario | str, **settings: Any) -> None:
        scenario = scenario_of(team)
        self.name = scenario.name
        self.notify: Callable[[], None] = lambda: None
        self._orders: deque[Pending] = deque()
        self._wake, self._open, self._watched = threading.Condition(), True, 0
        self._playing, self._speed, self._owed = True, SPEED, 0
        self._busy: str | None = None
        self._editor = Editor(scenario, settings, lambda: self.notify(), self._say_busy)  # noqa: PLW0108 - `notify` is set later
        self._display = self._editor.display
        self._display.show_round(self._editor.session)
        self._display.reassess(self._editor.session)
        self._show_state()
        self._thread = threading.Thread(target=self._run, name="consat session", daemon=True)

    @property
    def board(self) -> Board:
        """The latest content for pages."""
        return self._display.board

    @property
    def alive(self) -> bool:
        """Whether the session goes on."""
        return self._thread.is_alive()

    def start(self) -> None:
        """Begin to step."""
        self._thread.start()

    def close(self) -> None:
        """End the session, and wait for its threads."""
        with self._wake:
            self._open = False
            self._wake.notify()
        if self._thread.is_alive():
            self._thread.join(timeout=60.0)
        self._display.close()

    def watch(self, count: int) -> None:
        """Set the number of pages that watch. Without any, the session pauses."""
        with self._wake:
            self._watched = count
            self._wake.notify()

    def ask(self, order: Order, client: int, answer: Answer) -> None:
        """Queue an order. `answer` is called from another thread."""
        with self._wake:
            full = len(self._orders) >= MOST_PENDING
            if not full:
                self._orders.append(Pending(order, client, answer))
                self._wake.notify()
        if full:
            answer({"type": "answer", "id": order.id, "ok": False, "words": "too many orders wait already; send fewer"})

    def _run(self) -> None:
        due = time.monotonic()
        try:
            while True:
                with self._wake:
                    while self._open and not self._orders and (wait := self._wait(due)) > 0:
                        self._wake.wait(None if math.isinf(wait) else wait)
                    if not self._open:
                        return
                    pending, self._orders = list(self._orders), deque()
                self._carry_out(pending)
                now = time.monotonic()
                if self._owed or (self._playing and now >= due):
                    count = self._owed or max(1, round(self._speed / FRAMES))
                    self._owed = 0
                    self._step(count)
                    due = max(due + count / self._speed, now - 0.1)
                self._display.show_round(self._editor.session)
        finally:
            self._open = False
            self.notify()

    def _wait(self, due: float) -> float:
        """Time until the next round is due, s."""
        if self._owed:
            return 0.0
        return due - time.monotonic() if self._playing and self._watched else math.inf

    def _step(self, count: int) -> None:
        cold = self._editor.cold
        if cold:
            self._say_busy("compiling the rounds of the team")
        self._editor.session.step(count)
        if cold:
            self._editor.cold, self._busy = False, None
            self._show_state()

    def _carry_out(self, pending: list[Pending]) -> None:
        """Carry out orders. Of those that replace each other, only the last is; its answer goes to all of them."""
        last = {each.key: k for k, each in enumerate(pending)}
        late: dict[tuple[Any, ...], list[Pending]] = {}
        for k, each in enumerate(pending):
            if each.key is not None and last[each.key] != k:
                late.setdefault(each.key, []).append(each)
                continue
            answer = self._answered(each)
            for other in [*(late.pop(each.key, []) if each.key is not None else []), each]:
                other.answer(answer | {"id": other.order.id})

    def _answered(self, pending: Pending) -> dict[str, Any]:
        try:
            found = self._do(pending.order, pending.client)
        except ConsatError as error:
            return {"type": "answer", "ok": False, "words": str(error)[:1000]}
        finally:
            if self._busy is not None:
                self._busy = None
                self._show_state()
        return {"type": "answer", "ok": True, "words": "", "revision": self._display.revision, **found}

    def _do(self, order: Order, client: int) -> dict[str, Any]:
        """Carry out one order. Returns further entries of its answer. Raises: ConsatError: it is not possible; nothing has changed."""
        match order:
            case orders.Plain(do="text"):
                return {"text": self._editor.text()}
            case orders.Plain(do="play" | "pause"):
                self._playing = order.do == "play"
            case orders.Step():
                self._owed += order.rounds
            case orders.Speed():
                self._speed = order.rounds
            case _:
                self._editor.do(order, None if order.gesture is None else (client, order.gesture))
        self._show_state()
        return {}

    def _say_busy(self, what: str) -> None:
        self._busy = what
        self._show_state()

    def _show_state(self) -> None:
        editor = self._editor
        self._display.show("state", {
            "type": "state", "revision": self._display.revision, "playing": self._playing, "speed": self._speed, "busy": self._busy,
            "loss": editor.loss, "protocol": editor.session.protocol, "protocols": list(ROUNDS), "rate": editor.session.rate,
            "undo": len(editor.undos), "cut": editor.cut,
            "silent": {name: np.asarray(each.agent.start)[:3].tolist() for name, each in editor.silent.items()},
        })  # fmt: skip
