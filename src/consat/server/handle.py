"""``consat.live``: starts a session, a web server, and a browser that shows it."""

from __future__ import annotations

import os
import secrets
import socket
import sys
import threading
import time
import webbrowser
from contextlib import ExitStack
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, Final, Literal, Self, overload

from consat.errors import InvalidSettings, NetworkError
from consat.problem.team import Team
from consat.scenario import Scenario
from consat.server.simulation import Simulation

if TYPE_CHECKING:
    from consat.server.widget import LiveWidget

NEEDED: Final = ("starlette", "uvicorn", "websockets")
PORT: Final = 8137
LARGEST: Final = 65536
"""Size of a message that ends a connection, bytes. Shorter messages that are too long are answered."""


class Live:
    """A live team on a page.

    Args:
        simulation: the team. The constructor starts it.
        host: address that `listening` is bound to.
        listening: socket for connections.

    Attributes:
        url: address of the page.
    """

    def __init__(self, simulation: Simulation, host: str, listening: socket.socket) -> None:
        import uvicorn

        from consat.server.app import LOOPBACK, Host

        token = None if host in LOOPBACK else secrets.token_urlsafe(24)
        number = listening.getsockname()[1]
        name = f"[{host}]" if ":" in host else socket.gethostname() if host in ("0.0.0.0", "::") else host  # noqa: S104
        self.url = f"http://{name}:{number}/" + ("" if token is None else f"?token={token}")
        self._simulation = simulation
        config = uvicorn.Config(
            Host(simulation, token).app, log_level="critical", access_log=False, lifespan="off", ws="websockets-sansio",
            ws_max_size=LARGEST, ws_per_message_deflate=False, timeout_graceful_shutdown=1, server_header=False,
        )  # fmt: skip
        self._server = uvicorn.Server(config)
        self._thread = threading.Thread(target=self._server.run, args=([listening],), name="consat server", daemon=True)
        simulation.start()
        self._thread.start()
        while not self._server.started and self._thread.is_alive():
            time.sleep(0.01)

    @property
    def alive(self) -> bool:
        """Whether server and session go on."""
        return self._thread.is_alive() and self._simulation.alive

    def wait(self) -> Self:
        """Wait until the session ends. Ctrl-C ends it."""
        try:
            while self.alive:
                time.sleep(0.2)
        except KeyboardInterrupt:
            pass
        self.close()
        return self

    def close(self) -> None:
        """End the session and the server."""
        self._server.should_exit = True
        self._simulation.close()
        self._thread.join(timeout=10.0)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"<Live {self._simulation.name} at {self.url}{'' if self.alive else ', closed'}>"


@overload
def live(
    team: Team | Scenario | str, *, host: str = ..., port: int | None = ..., open_page: bool = ..., block: bool | None = ...,
    widget: Literal[False], **settings: Any,
) -> Live: ...  # fmt: skip
@overload
def live(
    team: Team | Scenario | str, *, host: str = ..., port: int | None = ..., open_page: bool = ..., block: bool | None = ...,
    widget: bool | None = ..., **settings: Any,
) -> Live | LiveWidget: ...  # fmt: skip
def live(
    team: Team | Scenario | str, *, host: str = "127.0.0.1", port: int | None = None, open_page: bool = True, block: bool | None = None,
    widget: bool | None = None, **settings: Any,
) -> Live | LiveWidget:  # fmt: skip
    """Watch a team, and change it, on a page or in a notebook widget.

    Args:
        team: a `consat.Team` or a scenario, as in `consat.run`.
        host: address to listen on. Pages of other machines need the token at the end of `Live.url`.
        port: port to listen on; 0 for a free one; None for 8137, or a free one if it is taken.
        open_page: whether to open a browser.
        block: whether to return only when the session has ended, with Ctrl-C. None: only in scripts.
        widget: whether to return a widget, without a server. None: in notebooks, unless a port is given.
        settings: arguments of `consat.Session`, such as ``protocol``, ``seed`` and ``loss``.

    Returns:
        a handle with ``url`` and ``close()``, or the widget, with ``close()``.

    Raises:
        NetworkError: the address cannot be listened on.
        InvalidSettings: a library is not installed; the message says how to install it.
        ConsatError: as `consat.Session`.
    """
    if port is not None and (not isinstance(port, int) or isinstance(port, bool) or not 0 <= port < 65536):
        raise InvalidSettings(f"port is {port!r}, but must be a whole number from 0 to 65535")
    if widget or (widget is None and port is None and in_notebook()):
        if find_spec("anywidget") is None:
            serve = "or have the page served, with a port: consat.live(team, port=0)"
            raise InvalidSettings(f"the widget needs anywidget; install it with: pip install 'consat[notebook]', {serve}")
        from consat.server.widget import LiveWidget

        return LiveWidget(Simulation(team, **settings))
    require()
    with ExitStack() as stack:
        listening = stack.enter_context(_bound(host, port))
        found = Live(Simulation(team, **settings), host, listening)
        stack.pop_all()  # the server closes it
    if open_page:
        webbrowser.open(found.url)
    interactive = hasattr(sys, "ps1") or "ipykernel" in sys.modules
    return found if block is False or (block is None and interactive) else found.wait()


def require() -> None:
    """Raises: InvalidSettings: a library for the server is not installed."""
    if missing := [name for name in NEEDED if find_spec(name) is None]:
        raise InvalidSettings(f"the live page needs {', '.join(missing)}; install them with: pip install 'consat[live]'")


def in_notebook() -> bool:
    """Whether Python runs in a notebook: Jupyter, VS Code or marimo."""
    if "marimo" in sys.modules:
        import marimo

        if marimo.running_in_notebook():
            return True
    if "IPython" not in sys.modules:
        return False
    from IPython import get_ipython

    return getattr(get_ipython(), "kernel", None) is not None


def _bound(host: str, port: int | None) -> socket.socket:
    """A socket that listens on an address. Raises: NetworkError: it cannot."""
    found = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    if os.name == "posix":
        found.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    found.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)  # else an answer waits 40 ms for the next frame
    try:
        found.bind((host, PORT if port is None else port))
        found.listen()
        return found
    except OSError as error:
        found.close()
        if port is None:
            return _bound(host, 0)
        raise NetworkError(f"nothing can listen on {host}, port {port}: {error.strerror or error}; choose another") from None
