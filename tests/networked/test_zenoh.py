"""Agents over zenoh, on 127.0.0.1 only."""

from __future__ import annotations

import json
import signal
import sys
import time

import pytest
import zenoh
from hypothesis import given
from hypothesis import strategies as st

from consat.errors import NetworkError
from consat.network.names import LONGEST, spelled
from consat.network.transports.zenoh import LEASE, MOST_BYTES, MOST_MESSAGES, Inbox, _key, _settings, _token, connect
from tests.networked.loopback import delivered, endpoints, gathered, letter, process, team, until

CHILD = """
import sys
from consat.network.transports.zenoh import connect
me, other, listen, address = sys.argv[1:]
agent = connect("test", me, listen, {other: address}, reliable=True)
while True:
    agent.wait(1)
    agent.receive()
"""


@pytest.mark.parametrize("reliable", [False, True], ids=["drop", "block"])
@pytest.mark.parametrize(
    ("a", "b"), [("a1", "a2"), ("a/*", "**"), ("..", "@x $?#"), ("Ärger 🤖", "%C3%84rger"), ("x" * 200, "x" * 201)], ids=str
)
def test_messages_pass_both_ways_whatever_the_agents_are_called(a: str, b: str, reliable: bool) -> None:
    with team() as agents:
        first, second = agents.pair(a, b, reliable=reliable)
        for sender, receiver, source, destination in ((first, second, a, b), (second, first, b, a)):
            sent = [letter(source, destination, number) for number in range(20)]
            for burst in [sent] if reliable else [[payload] for payload in sent]:  # where full queues drop, a burst may lose some
                for payload in burst:
                    sender.send(destination, payload)
                assert gathered(receiver, len(burst)) == burst
        assert (first.alive(), second.alive()) == ({b}, {a})


def test_large_messages_pass() -> None:
    with team() as agents:
        first, second = agents.pair()
        sent = letter("a", "b", 1, *range(1, 100_001))
        first.send("b", sent)
        assert gathered(second, 1) == [sent]


def test_reliable_messages_all_arrive_in_order() -> None:
    burst = MOST_MESSAGES // 2
    with team() as agents:
        first, second = agents.pair(reliable=True)
        for start in range(0, 20 * burst, burst):
            sent = [letter("a", "b", number) for number in range(start, start + burst)]
            for payload in sent:
                first.send("b", payload)
            assert gathered(second, burst) == sent


def test_wait_tells_whether_something_came() -> None:
    with team() as agents:
        first, second = agents.pair()
        began = time.monotonic()
        assert not second.wait(0.2)
        assert 0.15 < time.monotonic() - began < 5
        first.send("b", letter("a", "b"))
        assert second.wait(5.0)
        assert second.wait(0.0), "until it is taken"
        assert len(second.receive()) == 1
        assert not second.wait(0.0)
        assert second.receive() == []


def test_peers_relay_nothing() -> None:
    """In a line a – b – c, what c says to a does not get there by way of b: links are the scenario's, and nobody else's."""
    at_a, at_b, at_c = endpoints(3)
    with team() as agents:
        a, b = agents.join("a", at_a, {"b": at_b, "c": at_c}), agents.join("b", at_b, {"a": at_a, "c": at_c})
        until(lambda: a.alive() == {"b"} and b.alive() == {"a"})
        # An agent that the others listen to, but that is connected to b only.
        lone = zenoh.Config()
        for key, value in _settings(endpoints(1)[0], [at_b]).items():
            lone.insert_json5(key, json.dumps(value))
        with zenoh.open(lone) as c:
            until(c.info.peers_zid)
            assert delivered(lambda: c.put(_key("test", "c", "b"), letter("c", "b")), b), "positive control"
            assert not delivered(lambda: c.put(_key("test", "c", "a"), letter("c", "a")), a)


def test_nobody_is_found_who_is_not_told() -> None:
    with team() as agents:
        at_a, at_b = endpoints(2)
        a, b = agents.join("a", at_a, {}), agents.join("b", at_b, {})
        time.sleep(1.0)
        assert not list(a._session.info.peers_zid())
        assert not list(b._session.info.peers_zid())


def test_runs_do_not_hear_each_other() -> None:
    with team() as agents:
        at_a, at_b = endpoints(2)
        a, b = agents.join("a", at_a, {"b": at_b}, run="one"), agents.join("b", at_b, {"a": at_a}, run="two")
        until(lambda: list(a._session.info.peers_zid()))
        assert not delivered(lambda: a.send("b", letter("a", "b")), b)
        assert not a.alive()


def test_nobody_speaks_in_anothers_name() -> None:
    """The name in a message must be that of the neighbour whose key it came on."""
    with team() as agents:
        first, second = agents.pair()
        assert not delivered(lambda: first.send("b", letter("c", "b")), second, 0.3)
        assert second.misnamed["a"] > 5
        assert delivered(lambda: first.send("b", letter("a", "b")), second, 0.3)


def test_a_flood_leaves_the_newest() -> None:
    with team() as agents:
        first, second = agents.pair()
        count = 4 * MOST_MESSAGES
        for number in range(count):
            first.send("b", letter("a", "b", number))
            time.sleep(0.0002)
        last = letter("a", "b", count)
        until(lambda: first.send("b", last) or last in second._inboxes["a"]._waiting)
        assert len(second.receive()) <= MOST_MESSAGES
        assert second._inboxes["a"].dropped >= count // 2


def test_inbox_is_bounded_in_number_and_bytes() -> None:
    inbox = Inbox(most=3, most_bytes=10)
    for letters in ("aa", "bb", "cc", "dd"):
        inbox.put(letters.encode())
    assert inbox.take() == [b"bb", b"cc", b"dd"]
    assert inbox.take() == []
    for size in (6, 3, 4):
        inbox.put(bytes(size))
    assert [len(payload) for payload in inbox.take()] == [3, 4]
    inbox.put(bytes(11))
    assert inbox.take() == []
    assert inbox.dropped == 3
    assert MOST_BYTES < 2**24


def test_who_closes_is_seen_to_leave() -> None:
    with team() as agents:
        first, second = agents.pair()
        second.close()
        assert until(lambda: not first.alive()) < 1
        second.close()
        with pytest.raises(NetworkError, match="cannot send to 'a'"):
            second.send("a", b"")
        first.send("b", b"nobody hears it")


def test_sending_before_a_neighbour_is_there_is_no_error_and_it_is_found_later() -> None:
    with team() as agents:
        at_a, at_b = endpoints(2)
        began = time.monotonic()
        first = agents.join("a", at_a, {"b": at_b}, reliable=True)
        first.send("b", letter("a", "b"))
        assert time.monotonic() - began < 2
        time.sleep(1.5)  # several attempts to connect have failed by now
        second = agents.join("b", at_b, {"a": at_a}, reliable=True)
        until(lambda: first.alive() and second.alive())
        assert delivered(lambda: first.send("b", letter("a", "b")), second, 0.3)


def test_killed_process_is_seen_at_once_and_so_is_its_successor() -> None:
    at_a, at_b = endpoints(2)
    with team() as agents:
        first = agents.join("a", at_a, {"b": at_b})
        for _ in range(2):
            with process(CHILD, "b", "a", at_b, at_a) as child:
                until(first.alive)
                child.kill()
                assert until(lambda: not first.alive()) < 1


@pytest.mark.parametrize(("me", "other"), [("a", "b"), ("b", "a")], ids=["it connects", "we connect"])
def test_hung_process_is_seen_within_the_lease_and_does_not_hold_up_its_neighbour(me: str, other: str) -> None:
    here, there = endpoints(2)
    with team() as agents, process(CHILD, other, me, there, here) as child:
        first = agents.join(me, here, {other: there}, reliable=True)
        until(first.alive)
        for _ in range(3):
            child.send_signal(signal.SIGSTOP)
            began, longest = time.monotonic(), 0.0
            while first.alive():
                before = time.monotonic()
                assert before - began < 10
                first.send(other, letter(me, other))
                longest = max(longest, time.monotonic() - before)
                time.sleep(0.002)
            assert 0.5 * LEASE / 1000 < time.monotonic() - began < 4 * LEASE / 1000
            assert longest < 2 * LEASE / 1000
            child.send_signal(signal.SIGCONT)
            until(first.alive)


def test_port_in_use_is_an_error_in_words() -> None:
    at_a, at_b = endpoints(2)
    with team() as agents:
        agents.join("a", at_a, {"b": at_b})
        with pytest.raises(NetworkError, match=r"agent 'c' cannot listen at tcp/127\.0\.0\.1:\d+: .*in use") as error:
            connect("test", "c", at_a, {"b": at_b}, reliable=False, credentials=None)
        assert ".rs" not in str(error.value)


def test_tls_without_keys_is_an_error() -> None:
    with pytest.raises(NetworkError, match="without keys none may"):
        connect("test", "a", "tls/127.0.0.1:1", {})
    with pytest.raises(NetworkError, match="without keys none may"):
        connect("test", "a", "tcp/127.0.0.1:1", {"b": "tls/127.0.0.1:2"})


def test_missing_library_is_an_error_with_its_cure(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "zenoh", None)
    with pytest.raises(NetworkError, match=r"pip install 'consat\[network\]'"):
        connect("test", "a", "tcp/127.0.0.1:1", {})


@given(st.text(min_size=1, max_size=80))
def test_spelled_names_are_fit_for_keys_certificates_and_files(text: str) -> None:
    name = spelled(text)
    assert 0 < len(name) <= LONGEST
    assert name.isascii()
    assert all(letter.isalnum() or letter in "_-~%" for letter in name)
    for key in (_key(text, text, text), _token(text, text)):
        assert str(zenoh.KeyExpr(key)) == key
        assert not set(key) & set("*$?#")


@given(st.lists(st.text(st.sampled_from("aA%25.Fé /"), min_size=1, max_size=40), min_size=2, max_size=20, unique=True))
def test_different_names_are_spelled_differently(names: list[str]) -> None:
    assert len({spelled(name) for name in names}) == len(names)


def test_names_that_cannot_be_spelled_are_errors() -> None:
    for name in ("", "\ud800"):
        with pytest.raises(NetworkError, match="a name must"):
            spelled(name)
