"""The pieces that agents on a network are made of, each by itself."""

import itertools
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.console import Console

from consat.errors import InvalidSettings, NetworkError
from consat.faults import Channel, Faults
from consat.network.deploy.dashboard import table
from consat.network.deploy.environment import prepare
from consat.network.deploy.observer import Observer
from consat.network.node.body import CONFIRMED, MeasuredBody, Measurement, SimulatedBody
from consat.network.node.build import core_of
from consat.network.node.membership import Membership
from consat.network.node.modes import NodeSettings
from consat.network.node.persistence import Store
from consat.network.transports.faults import FaultyTransport
from consat.network.transports.memory import LATENCY, MemoryNetwork
from consat.scenario import load
from tests.networked.case_c import parts

# -- persistence -------------------------------------------------------------------------------------------------------------------------


def test_a_store_gives_back_the_last_record(tmp_path: Path) -> None:
    store = Store(tmp_path / "state", 64)
    assert store.load() is None
    for k in range(5):
        store.save(b"%d" % k * (k + 1))
    again = Store(tmp_path / "state", 64)
    assert again.load() == b"44444"
    again.save(b"next")
    assert Store(tmp_path / "state", 64).load() == b"next"


@given(st.integers(0, 2 * (28 + 64) - 1), st.integers(1, 255))
def test_a_store_with_a_torn_record_gives_the_one_before(tmp_path_factory: pytest.TempPathFactory, at: int, flip: int) -> None:
    """Whatever byte is wrong, what comes is one of the last two records, whole."""
    path = tmp_path_factory.mktemp("store") / "state"
    store = Store(path, 64)
    store.save(b"old" * 20)
    store.save(b"new" * 21)
    data = bytearray(path.read_bytes())
    data[at] ^= flip
    path.write_bytes(data)
    assert Store(path, 64).load() in {b"old" * 20, b"new" * 21}


def test_a_store_refuses_the_file_of_another(tmp_path: Path) -> None:
    Store(tmp_path / "state", 64)
    with pytest.raises(NetworkError, match="is not the memory of this agent"):
        Store(tmp_path / "state", 65)


# -- transports --------------------------------------------------------------------------------------------------------------------------


def test_the_air_delays_repeats_and_loses_by_seed() -> None:
    def run(seed: int) -> list[bytes]:
        network = MemoryNetwork(Faults(loss=0.3, delay=(0.0, 1.0), repeat=0.2, seed=seed))
        a, b = network.endpoint("a", ["b"]), network.endpoint("b", ["a"])
        for k in range(1000):
            a.send("b", b"%d" % k)
        network.now = 1.0
        network.deliver()
        return b.receive()

    got = run(0)
    assert got == run(0) != run(1)
    assert len(set(got)) == pytest.approx(760, abs=50)  # 1 − 0.3 (0.8 + 0.2 · 0.3) = 0.742 of them come, …
    assert len(got) == pytest.approx(840, abs=50)  # … 0.7 · 1.2 in all
    assert got != sorted(got, key=int)


def test_nothing_passes_a_partition_nor_reaches_whom_one_is_not_linked_to() -> None:
    network = MemoryNetwork()
    ends = {agent: network.endpoint(agent, others) for agent, others in (("a", "b"), ("b", "ac"), ("c", "b"))}
    network.partition({"a"}, {"b", "c"})
    ends["a"].send("b", b"1")
    ends["b"].send("c", b"2")
    ends["a"].send("c", b"3")
    network.now = 1.0
    assert network.deliver() == {"c"}
    assert ends["c"].receive() == [b"2"]
    assert (ends["a"].alive(), ends["b"].alive()) == (frozenset(), frozenset("c"))
    network.partition()
    assert ends["a"].alive() == frozenset("b")
    ends["b"].close()
    assert ends["a"].alive() == frozenset()


def test_faults_hold_back_and_lose() -> None:
    network = MemoryNetwork(Faults(delay=(0.0, 0.0)))
    a, b = (
        network.endpoint("a", ["b"]),
        FaultyTransport(network.endpoint("b", ["a"]), network.clock, Faults(loss=0.25, delay=(1.0, 2.0), seed=3)),
    )
    for k in range(400):
        a.send("b", b"%d" % k)
    network.now = LATENCY
    network.deliver()
    assert b.receive() == []
    network.now = 0.99
    assert b.receive() == []
    network.now = LATENCY + 1.5
    early = b.receive()
    network.now = LATENCY + 2.0
    late = b.receive()
    assert len(early) + len(late) == pytest.approx(300, abs=40)
    assert len(early) == pytest.approx(150, abs=40)


def test_losses_come_in_bursts() -> None:
    channel = Channel(Faults(burst=(0.02, 0.1)), np.random.default_rng(0))
    lost = np.array([not channel.delays() for _ in range(20_000)])
    starts = np.flatnonzero(np.diff(lost.astype(int)) == 1)
    assert lost.mean() == pytest.approx(0.02 / 0.12, abs=0.02)  # p / (p + q)
    assert lost.sum() / len(starts) == pytest.approx(10, abs=1)  # 1 / q
    with pytest.raises(InvalidSettings, match="must be two probabilities"):
        Faults(burst=(0.5, 1.5))


# -- membership --------------------------------------------------------------------------------------------------------------------------


@given(st.permutations([("a1", 1.0), ("a1", 2.0), ("a3", 1.0), ("a1", 3.0), ("a3", 1.0)]))
def test_members_are_the_same_in_whatever_order_news_come(news: list[tuple[str, float]]) -> None:
    known = Membership(parts()["a2"])
    for agent, epoch in news:
        known.update([agent], np.array([epoch]))
    assert known.gone == {"a1", "a3"}
    assert known.of(["a1", "a2", "a3"]).tolist() == [3.0, 0.0, 1.0]


def test_whoever_is_falsely_said_to_have_left_objects() -> None:
    me, other = Membership(parts()["a1"]), Membership(parts()["a2"])
    other.drop("a1")
    me.update(["a1"], other.of(["a1"]))
    assert me.gone == frozenset()
    other.update(["a1"], me.of(["a1"]))
    assert other.gone == frozenset()


@pytest.mark.parametrize("told", [np.nan, np.inf, -1.0, 0.5, 1e300])
def test_absurd_numbers_of_members_are_ignored(told: float) -> None:
    known = Membership(parts()["a2"])
    known.update(["a1"], np.array([told]))
    assert known.of(["a1"]) == 0.0


# -- bodies ------------------------------------------------------------------------------------------------------------------------------


def test_a_simulated_body_moves_straight_and_no_faster_than_allowed() -> None:
    body = SimulatedBody(np.zeros(2), speed=2.0)
    body.follow(np.array([3.0, 4.0]), 0.0)
    body.follow(np.array([3.0, 4.0]), 0.5)
    np.testing.assert_allclose(body.position(), [0.6, 0.8])
    body.follow(np.array([3.0, 4.0]), 10.0)
    np.testing.assert_allclose(body.position(), [3.0, 4.0])


def test_a_measured_body_stands_still_until_it_is_measured() -> None:
    body = MeasuredBody(speed=1.0)
    assert body.command(np.ones(2), 0.0).tolist() == [0.0, 0.0]
    assert body.measure(Measurement(np.array([1.0, 0.9]), 1.0)) is None
    np.testing.assert_allclose(body.command(np.ones(2), 1.0), [0.0, 0.2])  # 0.1 in 0.5 s
    assert body.measure(Measurement(np.array([1.0, -0.5]), 2.0)) is None
    np.testing.assert_allclose(body.command(np.ones(2), 2.0), [0.0, 1.0])


def sightings(body: MeasuredBody, *record: tuple[float, float] | tuple[float, float, float]) -> list[bool]:
    """Which measurements (time, x) or (time, x, stamp) are believed."""
    return [body.measure(Measurement(np.array([x, 0.0]), time, *stamp)) is None for time, x, *stamp in record]


def at(body: MeasuredBody) -> float:
    position = body.position()
    assert position is not None
    return float(position[0])


def test_a_measurement_farther_than_the_body_moves_is_not_believed() -> None:
    body = MeasuredBody(speed=1.0, timeout=0.5)
    assert sightings(body, (0.0, 0.0), (0.1, 0.59), (0.2, 1.2), (0.3, 50.0)) == [True, True, False, False]
    assert at(body) == 0.59
    assert "it is 49.4 from the last one, 0.3 s ago, but the body moves by 1 a second" in str(
        body.measure(Measurement(np.array([50.0, 0]), 0.4))
    )
    assert sightings(body, (0.5, 0.7)) == [True]
    assert sightings(MeasuredBody(), (0.0, 0.0), (0.1, 1e9)) == [True, True], "without a speed no distance is too far"


def test_a_robot_that_was_moved_is_found_again() -> None:
    body = MeasuredBody(speed=1.0)
    assert sightings(body, (0.0, 0.0), *((0.1 * k, 9.0 + 0.01 * k) for k in range(1, CONFIRMED + 1))) == [True, *[False] * 4, True]
    assert at(body) == 9.05
    wild = [(1.0 + 0.1 * k, 100.0 * (-1) ** k) for k in range(20)]
    assert not any(sightings(body, *wild)), "which do not agree with each other"
    between = [(3.0 + 0.1 * k, 9.05 if k % CONFIRMED == 0 else 50.0) for k in range(40)]
    assert sightings(body, *between) == [k % CONFIRMED == 0 for k in range(40)], "the last good one is confirmed in between"


def test_stamps_must_rise_until_the_sensor_starts_anew() -> None:
    body = MeasuredBody(speed=1.0, timeout=0.5)
    assert sightings(body, (0.0, 0.0, 10.0), (0.1, 0.1, 9.0), (0.2, 0.2, 10.0), (0.3, 0.3, 10.5)) == [True, False, False, True]
    assert at(body) == 0.3
    burst = [(0.4 + 0.001 * k, 0.1, 1.0 + k) for k in range(8)]
    assert not any(sightings(body, *burst)), "what was held up on the way, and comes now"
    assert sightings(body, (0.5, 0.4), (0.6, 0.5, 10.2), (0.7, 0.5, 11.0)) == [True, False, True], "one without a stamp changes nothing"
    anew = [(1.5 + 0.1 * k, 0.5, 1.0 + k) for k in range(CONFIRMED)]
    assert sightings(body, *anew) == [False] * (CONFIRMED - 1) + [True]


def test_a_body_that_is_not_measured_any_more_stands() -> None:
    body = MeasuredBody(speed=1.0, timeout=0.5)
    assert not body.sensed(0.0)
    sightings(body, (0.0, 0.0), (0.1, 90.0))
    assert body.sensed(0.5)
    assert not body.sensed(0.51), "what is not believed is no measurement"
    assert body.command(np.array([5.0, 0.0]), 0.5).tolist() == [1.0, 0.0]
    assert body.command(np.array([5.0, 0.0]), 0.51).tolist() == [0.0, 0.0]
    sightings(body, (0.6, 0.2))
    assert body.command(np.array([5.0, 0.0]), 0.6).tolist() == [1.0, 0.0]


# -- modes and environment ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("settings", "protocol", "message"),
    [
        ({"mode": "carrier-pigeon"}, None, "there is no mode 'carrier-pigeon'"),
        ({"mode": "admm", "memory": Path("x")}, None, "only lockstep takes a memory file"),
        ({"mode": "admm", "pace": 2.0}, None, "only link takes a pace"),
        ({"mode": "admm"}, "proximal", "mode lockstep runs every protocol in rounds"),
        ({"mode": "interior-point"}, "admm", "mode lockstep runs every protocol in rounds"),
        ({"mode": "link"}, "interior-point", "mode link runs the protocol gradient-flow"),
        ({"mode": "lockstep"}, "gradient-flow", "mode lockstep runs protocols in rounds"),
    ],
)
def test_modes_that_do_not_fit_are_refused(settings: dict[str, object], protocol: str | None, message: str) -> None:
    with pytest.raises(InvalidSettings, match=message):
        core_of(parts(*([f"protocol.kind={protocol}"] if protocol else []))["a2"], NodeSettings(**settings))  # type: ignore[arg-type]


def test_the_environment_keeps_what_the_user_has_set() -> None:
    environment = {"XLA_FLAGS": "--xla_cpu_max_isa=AVX2 --xla_dump_to=x", "OMP_NUM_THREADS": "3", "XDG_CACHE_HOME": "cache"}
    prepare(environment, exact=True)
    assert environment["OMP_NUM_THREADS"] == "3"
    assert environment["XLA_FLAGS"].split() == ["--xla_cpu_max_isa=AVX2", "--xla_dump_to=x", "--xla_cpu_multi_thread_eigen=false"]
    assert environment["JAX_COMPILATION_CACHE_DIR"] == str(Path("cache") / "consat" / "xla")


# -- what an observer makes of it --------------------------------------------------------------------------------------------------------


def report(agent: str, track: list[list[float]], *, up: bool = True, sent: int = 1, margin: float | None = 0.1) -> dict[str, object]:
    peers = {"a2": {"up": up, "silent": 0.0, "loss": 0.25, "trip": 0.002}}
    return {
        "event": "report", "id": agent, "t": 0.0, "track": track, "margin": margin, "known": 1.0, "peers": peers,
        "sent": {"messages": sent, "floats": 3 * sent}, "dropped": {}, "position": track[-1][1:] if track else None,
    }  # fmt: skip


def test_an_observer_knows_when_all_have_settled() -> None:
    observer = Observer(load("case-c").team, np.zeros((3, 2)), "time")
    for agent in ("a1", "a2", "a3"):
        observer.take([report(agent, [[0.1 * k, 2.0**-k, 0.0] for k in range(11)])])
    assert observer.settled(window=0.3, distance=0.02)
    assert not observer.settled(window=0.3, distance=0.002)
    assert not observer.settled(window=2.0, distance=10.0)  # nothing is known of that long
    observer.take([report("a3", [[1.1, 0.0, 0.0]], up=False)])
    assert not observer.settled(window=0.3, distance=0.02)


def test_an_observer_counts_what_was_sent_in_all_lives() -> None:
    observer = Observer(load("case-c").team, np.zeros((3, 2)), "time")
    start = {"event": "start", "id": "a1", "t": 1.0}
    observer.take([start, report("a1", [], sent=5), report("a1", [], sent=7), start, report("a1", [], sent=2), {"event": "?", "id": "a1"}])
    assert observer.records["a1"].sent["messages"] == 9
    assert observer.records["a1"].sent["floats"] == 27


def test_an_observer_knows_only_what_all_know() -> None:
    observer = Observer(load("case-c").team, np.zeros((3, 2)), "round")
    for number, agent in itertools.product((1, 2), ("a1", "a2", "a3")):
        observer.take([{"event": "satisfied", "id": agent, "stamp": 10.0 * number}])
        known = number == 2 or agent == "a3"
        assert observer.all_known() == (("satisfied", 10.0) if known else (None, None))
        assert (observer.concluded() is not None) == known
    observer.take([{"event": "unsatisfied", "id": "a2", "stamp": 30.0}])
    assert observer.all_known() == (None, None)
    assert observer.concluded() is None


def test_an_observer_waits_until_all_know_that_they_are_near_the_best() -> None:
    observer = Observer(load("case-d").team, np.zeros((3, 2)), "round")
    for stamp, agent in enumerate(("a1", "a2", "a3")):
        observer.take([{"event": "infeasible", "id": agent, "stamp": stamp, "near": False, "bound": -0.5, "margin": None}])
    assert observer.all_known() == ("infeasible", 2)
    for stamp, agent in enumerate(("a1", "a2", "a3"), 10):
        assert observer.concluded() is None
        observer.take([{"event": "infeasible", "id": agent, "stamp": stamp, "near": True, "bound": -0.5, "margin": -0.51}])
    assert observer.all_known() == ("infeasible", 2)
    assert observer.concluded() == 12
    observer.take([{"event": "undecided", "id": "a3", "stamp": 20.0}])  # somebody left
    assert observer.all_known() == (None, None)


def test_the_table_shows_margins_links_and_who_is_down() -> None:
    observer = Observer(load("case-c").team, np.zeros((3, 2)), "time")
    observer.take([report("a1", [[0.0, 1.0, 1.0]], margin=-0.25), report("a3", [], up=False)])
    console = Console(width=120, record=True, file=open("/dev/null", "w"))  # noqa: SIM115, PTH123
    with console.file:
        console.print(table("case-c", observer, {"a1": True, "a2": False, "a3": True}, 1.5))
        shown = console.export_text()
    rows = {line.split("│")[1].strip(): line for line in shown.splitlines() if line.startswith("│")}
    assert "case-c: 1.5 s, margin -0.25" in shown
    assert all(text in rows["a1"] for text in ("running", "-0.25", "25%", "2.0 ms"))
    assert "down" in rows["a2"]
    assert rows["a3"].rstrip("│ ").endswith("a2")
