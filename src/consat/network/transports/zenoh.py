"""Transport over eclipse-zenoh. Agents are peers that connect to their neighbours only and relay nothing.

An agent publishes to ``consat/<run>/v1/e/<itself>/<neighbour>`` and shows that it is up with the token ``consat/<run>/v1/live/<itself>``.
With credentials, each link is mutual TLS, and access control restricts a neighbour to the keys that contain its name: see docs/security.md.
"""

from __future__ import annotations

import functools
import json
import re
import threading
from collections import Counter, deque
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

from consat.errors import NetworkError
from consat.network import wire
from consat.network.names import spelled
from consat.network.transports import Transport

if TYPE_CHECKING:
    import zenoh

    from consat.network.keys import Credentials

LEASE: Final = 1000
"""Silence after which a link is closed, ms. Zenoh sends four keep-alive messages in this time."""
MOST_MESSAGES: Final = 256
"""Largest number of messages from one neighbour that wait to be read; the oldest are dropped."""
MOST_BYTES: Final = 2**23
"""Largest total size of these messages, bytes; the oldest are dropped."""


def connect(
    run: str, me: str, listen: str, neighbours: Mapping[str, str], *, reliable: bool = False, credentials: Credentials | None = None
) -> Transport:
    """Open the links of an agent to its neighbours. Returns at once; connections are retried without end.

    Args:
        run: id of the run. Agents of other runs are not heard.
        me: id of this agent.
        listen: address at which this agent listens, e.g. ``tcp/127.0.0.1:7447``; ``tls/…`` with credentials.
        neighbours: address of each neighbour, by id.
        reliable: whether sending waits if the queue is full. Otherwise the message is dropped.
        credentials: for mutual TLS and access control. If None, anybody who reaches the port can send messages.

    Raises:
        NetworkError: the library is missing, the port is in use, an address does not fit the credentials, or a key file is missing.
    """
    try:
        import zenoh
    except ImportError:
        raise NetworkError("agents on a network need eclipse-zenoh, which is not installed; pip install 'consat[network]'") from None
    for endpoint in (listen, *neighbours.values()):
        if endpoint.startswith("tls/") != (credentials is not None):
            raise NetworkError(f"with keys every address must begin with tls/, without keys none may, but one is {endpoint!r}")
    config = zenoh.Config()
    # Only one of two neighbours connects. If both did, a new link could be added to an old session that the other end still holds, and
    # that session would never declare its token and subscriptions again.
    settings = _settings(listen, [endpoint for neighbour, endpoint in neighbours.items() if spelled(neighbour) < spelled(me)])
    if credentials is not None:
        for path in (credentials.ca, credentials.certificate, credentials.key):
            if not path.is_file():
                raise NetworkError(f"there is no file {path}; `consat keys` makes it")
        settings |= _protection(credentials) | {"access_control": _access(run, me, neighbours)}
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    try:
        session = zenoh.open(config)
    except zenoh.ZError as error:
        raise NetworkError(f"agent {me!r} cannot listen at {listen}: {_words(error)}") from None
    try:
        return _Zenoh(session, run, me, neighbours, reliable)
    except zenoh.ZError as error:
        session.close()
        raise NetworkError(f"agent {me!r} cannot join run {run!r}: {_words(error)}") from None


def _words(error: Exception) -> str:
    """The message of a zenoh error, without locations in zenoh's source code."""
    return re.sub(r" at \S+\.rs:\d+\.?", "", str(error))


def _key(run: str, source: str, destination: str) -> str:
    return f"consat/{spelled(run)}/v1/e/{spelled(source)}/{spelled(destination)}"


def _token(run: str, agent: str) -> str:
    return f"consat/{spelled(run)}/v1/live/{spelled(agent)}"


def _settings(listen: str, connect: Sequence[str]) -> dict[str, Any]:
    """Zenoh settings: connect only to the given endpoints, without discovery, and retry without end."""
    return {
        "mode": "peer",
        "listen/endpoints": [listen],
        "connect/endpoints": connect,
        "connect/timeout_ms": -1,
        "connect/exit_on_failure": False,
        "connect/retry": {"period_init_ms": 50, "period_max_ms": 250, "period_increase_factor": 2},
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "scouting/delay": 0,
        "open/return_conditions": {"connect_scouted": False, "declares": False},
        "adminspace/enabled": False,
        "transport/link/tx/lease": LEASE,
        # A neighbour that hangs must not block messages to the others for longer than the lease.
        "transport/link/tx/queue/congestion_control/block/wait_before_close": 1000 * LEASE,
        "transport/link/rx/max_message_size": 2 * wire.LONGEST,
        # Shared memory between neighbours on one machine would bypass TLS.
        "transport/shared_memory/enabled": False,
    }


def _protection(credentials: Credentials) -> dict[str, Any]:
    certificate, key = str(credentials.certificate), str(credentials.key)
    return {
        "transport/link/protocols": ["tls"],
        "transport/link/tls": {
            "root_ca_certificate": str(credentials.ca),
            "enable_mtls": True,
            "verify_name_on_connect": True,
            "close_link_on_expiration": True,
            "listen_certificate": certificate,
            "listen_private_key": key,
            "connect_certificate": certificate,
            "connect_private_key": key,
        },
    }


def _access(run: str, me: str, neighbours: Mapping[str, str]) -> dict[str, Any]:
    """Access control: the messages allowed on the link to each neighbour, by the common name of its certificate. All else is denied."""
    rules: list[dict[str, Any]] = []
    policies = []
    for number, neighbour in enumerate(neighbours):
        to, back, mine, its = _key(run, me, neighbour), _key(run, neighbour, me), _token(run, me), _token(run, neighbour)
        allowed = (
            ("egress", ["put", "declare_liveliness_subscriber"], [to, its]),
            ("egress", ["declare_subscriber", "liveliness_token"], [back, mine]),
            ("ingress", ["put", "declare_liveliness_subscriber"], [back, mine]),
            ("ingress", ["declare_subscriber", "liveliness_token"], [to, its]),
        )
        names = [f"{number}-{place}" for place in range(len(allowed))]
        rules += [
            {"id": name, "permission": "allow", "flows": [flow], "messages": messages, "key_exprs": keys}
            for name, (flow, messages, keys) in zip(names, allowed, strict=True)
        ]
        policies.append({"rules": names, "subjects": [str(number)]})
    subjects = [{"id": str(number), "cert_common_names": [spelled(neighbour)]} for number, neighbour in enumerate(neighbours)]
    return {"enabled": True, "default_permission": "deny", "rules": rules, "subjects": subjects, "policies": policies}


class Inbox:
    """Queue of the messages from one neighbour. Bounded in number and bytes: the oldest are dropped. Thread-safe.

    Args:
        most: largest number of messages.
        most_bytes: largest total size, bytes.

    Attributes:
        dropped: number of messages dropped so far.
    """

    def __init__(self, most: int = MOST_MESSAGES, most_bytes: int = MOST_BYTES) -> None:
        self.dropped = 0
        self._most = most
        self._most_bytes = most_bytes
        self._waiting: deque[bytes] = deque()
        self._bytes = 0
        self._lock = threading.Lock()

    def put(self, payload: bytes) -> None:
        """Append a message."""
        with self._lock:
            self._waiting.append(payload)
            self._bytes += len(payload)
            while len(self._waiting) > self._most or self._bytes > self._most_bytes:
                self._bytes -= len(self._waiting.popleft())
                self.dropped += 1

    def take(self) -> list[bytes]:
        """Remove and return all messages, the oldest first."""
        with self._lock:
            taken = list(self._waiting)
            self._waiting.clear()
            self._bytes = 0
        return taken


class _Zenoh:
    """The `Transport` of one agent on an open zenoh session."""

    def __init__(self, session: zenoh.Session, run: str, me: str, neighbours: Mapping[str, str], reliable: bool) -> None:
        import zenoh

        self.misnamed: Counter[str] = Counter()
        """Number of messages, by neighbour, whose sender field names another agent."""
        self._error = zenoh.ZError
        self._session = session
        self._arrived = threading.Event()
        self._inboxes = {neighbour: Inbox() for neighbour in neighbours}
        self._alive: set[str] = set()
        congestion = zenoh.CongestionControl.BLOCK if reliable else zenoh.CongestionControl.DROP
        self._publishers = {
            neighbour: session.declare_publisher(_key(run, me, neighbour), congestion_control=congestion, express=True)
            for neighbour in neighbours
        }
        for neighbour, inbox in self._inboxes.items():
            # The callbacks run in zenoh's threads.
            session.declare_subscriber(_key(run, neighbour, me), functools.partial(self._put, inbox))
            show = functools.partial(self._show, neighbour, zenoh.SampleKind.PUT)
            session.liveliness().declare_subscriber(_token(run, neighbour), show, history=True)
        self._token = session.liveliness().declare_token(_token(run, me))  # valid as long as this reference is kept

    def send(self, neighbour: str, payload: bytes) -> None:
        try:
            self._publishers[neighbour].put(payload)
        except self._error as error:
            raise NetworkError(f"cannot send to {neighbour!r}: {_words(error)}") from None

    def receive(self) -> list[bytes]:
        self._arrived.clear()  # clear first, so that a message that arrives meanwhile wakes the next `wait`
        received = []
        for neighbour, inbox in self._inboxes.items():
            for payload in inbox.take():
                if wire.claims(payload, neighbour):
                    received.append(payload)
                else:
                    self.misnamed[neighbour] += 1
        return received

    def wait(self, timeout: float) -> bool:
        return self._arrived.wait(timeout)

    def alive(self) -> frozenset[str]:
        return frozenset(self._alive.copy())

    def close(self) -> None:
        self._session.close()

    def _put(self, inbox: Inbox, sample: zenoh.Sample) -> None:
        if len(sample.payload) <= wire.LONGEST:
            inbox.put(sample.payload.to_bytes())
            self._arrived.set()

    def _show(self, neighbour: str, up: zenoh.SampleKind, sample: zenoh.Sample) -> None:
        if sample.kind == up:
            self._alive.add(neighbour)
        else:
            self._alive.discard(neighbour)
