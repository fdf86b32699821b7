"""Keys, and what those who have none, others, or their own can do with them: see docs/security.md, which these tests back."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import re
import shlex
import shutil
import stat
import subprocess
import sysconfig
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import zenoh
from click.testing import CliRunner
from cryptography import x509
from hypothesis import given
from hypothesis import strategies as st

from consat.cli import network as commands
from consat.cli.keys import keys as keys_command
from consat.errors import NetworkError
from consat.network import keys
from consat.network.names import CA, CA_KEY, CERTIFICATE, KEY, spelled
from consat.network.transports import zenoh as transport
from consat.network.transports.zenoh import _key, _protection, _settings, _token, connect
from tests.networked.loopback import SILENCE, delivered, endpoints, letter, team, until

SCRIPTS = Path(sysconfig.get_path("scripts"))
IDS = ("a", "b", "c", "outsider")


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Keys of a team."""
    directory = tmp_path_factory.mktemp("keys")
    keys.make(IDS, directory)
    return directory


@pytest.fixture(scope="module")
def foreign(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Keys for the same names, by another authority."""
    directory = tmp_path_factory.mktemp("foreign")
    keys.make(IDS, directory)
    return directory


@contextlib.contextmanager
def rogue(listen: str, target: str, **changes: Any) -> Iterator[zenoh.Session]:
    """Somebody who speaks zenoh, knows every name and address, and has no access control of its own."""
    config = zenoh.Config()
    for key, value in {**_settings(listen, [target]), **changes}.items():
        config.insert_json5(key, json.dumps(value))
    with zenoh.open(config) as session:
        yield session


def team_of_three(agents: Any, home: Path) -> tuple[Any, Any, Any, str]:
    """b – a – c, with keys; and a's address."""
    at_a, at_b, at_c = endpoints(3, "tls")
    a = agents.join("a", at_a, {"b": at_b, "c": at_c}, credentials=keys.load(home, "a"))
    b = agents.join("b", at_b, {"a": at_a}, credentials=keys.load(home, "b"))
    c = agents.join("c", at_c, {"a": at_a}, credentials=keys.load(home, "c"))
    until(lambda: a.alive() == {"b", "c"} and b.alive() == {"a"} and c.alive() == {"a"})
    return a, b, c, at_a


def attack(session: zenoh.Session, a: Any, victims: dict[str, bytes], friend: Callable[[], Any]) -> list[bytes]:
    """What a gets while the rogue writes all of it, and a friend writes, too."""

    def everybody() -> None:
        for key, payload in victims.items():
            session.put(key, payload, congestion_control=zenoh.CongestionControl.BLOCK)
        friend()

    return delivered(everybody, a)


FORGED = {
    _key("test", "b", "a"): letter("b", "a", 1000, 66.6),
    _key("test", "c", "a"): letter("c", "a", 1000, 66.6),
    _key("test", "outsider", "a"): letter("outsider", "a", 1000, 66.6),
}


def test_with_keys_messages_pass_both_ways_and_everybody_is_seen(home: Path) -> None:
    """Positive control of all below."""
    with team() as agents:
        a, b, c, _ = team_of_three(agents, home)
        for sender, source, receiver, destination in ((a, "a", b, "b"), (b, "b", a, "a"), (a, "a", c, "c"), (c, "c", a, "a")):
            payload = letter(source, destination)
            got = delivered(lambda s=sender, d=destination, p=payload: s.send(d, p), receiver, 0.3)
            assert len(got) > 10
            assert set(got) == {payload}


def test_a_neighbour_that_leaves_and_comes_back_is_seen_through_access_control(home: Path) -> None:
    at_a, at_b = endpoints(2, "tls")
    with team() as agents:
        a = agents.join("a", at_a, {"b": at_b}, credentials=keys.load(home, "a"))
        for _ in range(2):
            b = agents.join("b", at_b, {"a": at_a}, credentials=keys.load(home, "b"))
            until(lambda b=b: a.alive() and b.alive())
            assert delivered(lambda b=b: b.send("a", letter("b", "a")), a, 0.2)
            b.close()
            assert until(lambda: not a.alive()) < 1


def test_without_keys_a_forged_message_gets_in() -> None:
    """Negative control: the same rogue, and nobody has keys. This is what keys are for."""
    at_a, at_b, at_c, at_rogue = endpoints(4)
    with team() as agents:
        a = agents.join("a", at_a, {"b": at_b, "c": at_c})
        with rogue(at_rogue, at_a) as session:
            until(session.info.peers_zid)
            got = attack(session, a, FORGED, lambda: None)
    assert letter("b", "a", 1000, 66.6) in got


ROGUES = ["plain TCP", "no certificate", "foreign authority", "an agent that is no neighbour"]


@pytest.mark.parametrize("kind", ROGUES)
def test_rogue_delivers_nothing(kind: str, home: Path, foreign: Path) -> None:
    with team() as agents:
        a, b, _, at_a = team_of_three(agents, home)
        friendly = letter("b", "a", 1)
        (listen,) = endpoints(1, "tcp" if kind == "plain TCP" else "tls")
        # The name of the certificate is that of a neighbour where the authority is foreign.
        shown = {"foreign authority": keys.load(foreign, "b"), "an agent that is no neighbour": keys.load(home, "outsider")}
        changes = _protection(shown.get(kind, keys.load(home, "outsider")))
        target = at_a
        if kind == "plain TCP":
            changes, target = {}, at_a.replace("tls/", "tcp/")
        if kind == "no certificate":
            tls = changes["transport/link/tls"]
            changes["transport/link/tls"] = {
                "root_ca_certificate": tls["root_ca_certificate"], "verify_name_on_connect": False,
                "listen_certificate": tls["listen_certificate"], "listen_private_key": tls["listen_private_key"],
            }  # fmt: skip
        if kind == "foreign authority":
            # It trusts whoever it meets: a's certificate must not save a from it.
            changes["transport/link/tls"] |= {"root_ca_certificate": str(home / CA), "verify_name_on_connect": False}
        with rogue(listen, target, **changes) as session:
            if kind == "an agent that is no neighbour":
                until(session.info.peers_zid)  # it belongs to the team: it may connect, and that is all
            got = attack(session, a, FORGED, lambda: b.send("a", friendly))
            if kind != "an agent that is no neighbour":
                assert not list(session.info.peers_zid())
    assert len(got) > 10, "positive control: the friend is heard meanwhile"
    assert set(got) == {friendly}


def test_without_mutual_tls_one_without_a_certificate_would_get_in(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Negative control: the test above can fail. Access control stays on, and still keeps its messages out."""
    protection = _protection(keys.load(home, "a"))
    protection["transport/link/tls"]["enable_mtls"] = False
    nameless = _protection(keys.load(home, "outsider"))
    nameless["transport/link/tls"] |= {"enable_mtls": False, "connect_certificate": None, "connect_private_key": None}
    (at_a, at_b, listen) = endpoints(3, "tls")
    with team() as agents:
        monkeypatch.setattr(transport, "_protection", lambda _: protection)
        a = agents.join("a", at_a, {"b": at_b}, credentials=keys.load(home, "a"))
        with rogue(listen, at_a, **nameless) as session:
            until(session.info.peers_zid)
            assert not attack(session, a, FORGED, lambda: None)


def test_without_access_control_an_insider_would_get_in(home: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Negative control of the tests below."""
    at_a, at_b, at_c = endpoints(3, "tls")
    with team() as agents:
        monkeypatch.setattr(transport, "_access", lambda *_: {"enabled": False})
        a = agents.join("a", at_a, {"b": at_b, "c": at_c}, credentials=keys.load(home, "a"))
        with insider(at_a, keys.load(home, "b")) as session:
            until(session.info.peers_zid)
            got = attack(session, a, FORGED, lambda: None)
    assert letter("c", "a", 1000, 66.6) in got


def insider(at_a: str, credentials: keys.Credentials) -> Any:
    return rogue(endpoints(1, "tls")[0], at_a, **_protection(credentials))


def test_insider_cannot_write_anothers_key(home: Path) -> None:
    """b's certificate is good, and b is a's neighbour; it may speak for b, and in no other name."""
    at_a, at_b, at_c = endpoints(3, "tls")
    own, spoof = letter("b", "a", 1, 1.0), letter("c", "a", 1000, 66.6)
    with team() as agents:
        a = agents.join("a", at_a, {"b": at_b, "c": at_c}, credentials=keys.load(home, "a"))
        with insider(at_a, keys.load(home, "b")) as session:
            until(session.info.peers_zid)
            writes = {_key("test", "c", "a"): spoof, _key("test", "b", "a"): own, _key("test", "*", "a"): spoof}
            writes |= {"consat/test/v1/e/**": spoof, "**": spoof}
            got = attack(session, a, writes, lambda: None)
            assert len(got) > 10, "positive control: what b says as b gets in"
            assert set(got) == {own}
            assert not a.misnamed
            got = attack(session, a, {_key("test", "b", "a"): spoof}, lambda: None)
            assert not got, "c's name on b's key"
            assert a.misnamed["b"] > 10


def test_insider_cannot_feign_that_another_lives(home: Path) -> None:
    at_a, at_b, at_c = endpoints(3, "tls")
    with team() as agents:
        a = agents.join("a", at_a, {"b": at_b, "c": at_c}, credentials=keys.load(home, "a"))
        with insider(at_a, keys.load(home, "b")) as session:
            until(session.info.peers_zid)
            tokens = [session.liveliness().declare_token(_token("test", name)) for name in ("c", "b")]
            until(lambda: "b" in a.alive())
            time.sleep(SILENCE)
            assert a.alive() == {"b"}
            del tokens


def test_insider_cannot_listen_to_what_is_for_others(home: Path) -> None:
    heard: list[str] = []
    with team() as agents:
        a, b, _, at_a = team_of_three(agents, home)
        b.close()
        with insider(at_a, keys.load(home, "b")) as session:
            for pattern in ("**", "consat/test/v1/e/**", _key("test", "a", "c"), _key("test", "a", "b")):
                session.declare_subscriber(pattern, lambda sample: heard.append(str(sample.key_expr)), allowed_origin=zenoh.Locality.REMOTE)

            def talk() -> None:
                a.send("c", letter("a", "c"))
                a.send("b", letter("a", "b"))

            until(lambda: talk() or heard)
            delivered(talk, a)
    assert set(heard) == {_key("test", "a", "b")}, "what is for b, and that only"


@pytest.mark.parametrize("who", ["an agent that is no neighbour", "foreign authority"])
def test_who_takes_a_dead_neighbours_address_learns_nothing(who: str, home: Path, foreign: Path) -> None:
    """b connects to a's address, where somebody else listens now; certificates of the whole team are valid for 127.0.0.1."""
    at_a, at_b = endpoints(2, "tls")
    heard: list[str] = []
    credentials = keys.load(home, "outsider") if who == "an agent that is no neighbour" else keys.load(foreign, "a")
    with team() as agents, rogue(at_a, at_b, **_protection(credentials), **{"connect/endpoints": []}) as session:
        session.declare_subscriber("**", lambda sample: heard.append(str(sample.key_expr)), allowed_origin=zenoh.Locality.REMOTE)
        token = session.liveliness().declare_token(_token("test", "a"))
        b = agents.join("b", at_b, {"a": at_a}, credentials=keys.load(home, "b"))
        if who == "an agent that is no neighbour":
            until(session.info.peers_zid)

        def talk() -> None:
            b.send("a", letter("b", "a"))
            session.put(_key("test", "a", "b"), letter("a", "b", 1000, 66.6))

        assert not delivered(talk, b)
        assert not heard
        assert not b.alive()
        del token


def test_who_takes_a_dead_neighbours_address_without_keys_hears_all() -> None:
    """Negative control."""
    at_a, at_b = endpoints(2)
    heard: list[str] = []
    with team() as agents, rogue(at_a, at_b, **{"connect/endpoints": []}) as session:
        session.declare_subscriber("**", lambda sample: heard.append(str(sample.key_expr)), allowed_origin=zenoh.Locality.REMOTE)
        b = agents.join("b", at_b, {"a": at_a})
        until(lambda: b.send("a", letter("b", "a")) or heard)


def test_links_close_when_a_certificate_expires(tmp_path: Path) -> None:
    keys.make(["a", "b"], tmp_path)
    pair = keys._issue("b", keys._read_authority(tmp_path), keys._alternatives(["127.0.0.1"]), 4 / 86400)
    (tmp_path / "b" / "certificate.pem").write_bytes(keys._pem(pair.certificate))
    (tmp_path / "b" / "key.pem").write_bytes(keys._private_pem(pair.key))
    at_a, at_b = endpoints(2, "tls")
    with team() as agents:
        a = agents.join("a", at_a, {"b": at_b}, credentials=keys.load(tmp_path, "a"))
        agents.join("b", at_b, {"a": at_a}, credentials=keys.load(tmp_path, "b"))
        until(a.alive)
        assert until(lambda: not a.alive()) < 10


def test_keys_want_tls_everywhere(home: Path) -> None:
    """Nothing falls back to an open link because of an address."""
    for listen, other in (("tcp/127.0.0.1:1", "tls/127.0.0.1:2"), ("tls/127.0.0.1:1", "tcp/127.0.0.1:2")):
        with pytest.raises(NetworkError, match="with keys every address must begin with tls/"):
            connect("test", "a", listen, {"b": other}, credentials=keys.load(home, "a"))


def test_missing_key_file_is_an_error(home: Path) -> None:
    gone = dataclasses.replace(keys.load(home, "a"), key=home / "nowhere.pem")
    with pytest.raises(NetworkError, match=r"there is no file .*nowhere\.pem; `consat keys` makes it"):
        connect("test", "a", "tls/127.0.0.1:1", {}, credentials=gone)


# --- the files


def certificate(path: Path) -> x509.Certificate:
    return x509.load_pem_x509_certificate(path.read_bytes())


@pytest.mark.parametrize("umask", [0o000, 0o022, 0o077])
def test_private_files_are_private_whatever_the_umask(tmp_path: Path, umask: int) -> None:
    before = os.umask(umask)
    try:
        keys.make(["a"], tmp_path / "team")
    finally:
        os.umask(before)
    for path in (tmp_path / "team" / "ca-key.pem", tmp_path / "team" / "a" / "key.pem"):
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert stat.S_IMODE((tmp_path / "team" / "a").stat().st_mode) == 0o700


def test_certificates_say_what_they_must(tmp_path: Path) -> None:
    keys.make(["Ä/1"], tmp_path, addresses=["10.0.0.7", "robot-7.local", "127.0.0.1"], days=30)
    found = keys.load(tmp_path, "Ä/1")
    own, authority = certificate(found.certificate), certificate(found.ca)
    own.verify_directly_issued_by(authority)
    assert own.subject.rfc4514_string() == "CN=%C3%84%2F1"
    names = own.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    assert list(map(str, names.get_values_for_type(x509.IPAddress))) == ["127.0.0.1", "10.0.0.7"]
    assert names.get_values_for_type(x509.DNSName) == ["robot-7.local"]
    uses = own.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value
    assert {use.dotted_string for use in uses} == {"1.3.6.1.5.5.7.3.1", "1.3.6.1.5.5.7.3.2"}, "server and client"
    assert not own.extensions.get_extension_for_class(x509.BasicConstraints).value.ca
    assert authority.extensions.get_extension_for_class(x509.BasicConstraints).value == x509.BasicConstraints(ca=True, path_length=0)
    lasts = own.not_valid_after_utc - own.not_valid_before_utc
    assert lasts.days == 31, "30 days from now, and the day before for slow clocks"
    assert authority.not_valid_after_utc > own.not_valid_after_utc


def test_no_private_key_is_in_an_agents_folder_but_its_own(home: Path) -> None:
    authority = (home / "ca-key.pem").read_bytes()
    private = {path: path.read_bytes() for path in home.rglob("*.pem") if b"PRIVATE" in path.read_bytes()}
    assert sorted(path.relative_to(home).as_posix() for path in private) == [
        "a/key.pem",
        "b/key.pem",
        "c/key.pem",
        "ca-key.pem",
        "outsider/key.pem",
    ]
    assert len(set(private.values())) == len(private)
    assert all(authority not in path.read_bytes() for path in home.glob("*/*"))


def test_nothing_is_overwritten_unasked(tmp_path: Path) -> None:
    keys.make(["a", "b"], tmp_path)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*.pem")}
    with pytest.raises(NetworkError, match=r"'b': there are keys in .* already; replace them"):
        keys.make(["c", "b"], tmp_path)
    assert {path: path.read_bytes() for path in tmp_path.rglob("*.pem")} == before, "not even c's, so that it can be done again"
    keys.make(["c"], tmp_path)
    assert all(path.read_bytes() == content for path, content in before.items()), "the team grows"
    keys.load(tmp_path, "c")
    keys.make(["b"], tmp_path, replace=True)
    changed = {path.relative_to(tmp_path).as_posix() for path, content in before.items() if path.read_bytes() != content}
    assert changed == {"b/certificate.pem", "b/key.pem"}
    keys.load(tmp_path, "b")


def test_an_agents_own_folder_is_enough(home: Path, tmp_path: Path) -> None:
    shutil.copytree(home / "b", tmp_path / "my keys")
    assert keys.load(tmp_path / "my keys", "b").key == tmp_path / "my keys" / "key.pem"


def spoil_mode(folder: Path, foreign: Path) -> None:
    (folder / "key.pem").chmod(0o644)


def spoil_key(folder: Path, foreign: Path) -> None:
    shutil.copy(foreign / "a" / "key.pem", folder / "key.pem")


def spoil_authority(folder: Path, foreign: Path) -> None:
    shutil.copy(foreign / "ca.pem", folder / "ca.pem")


def spoil_certificate(folder: Path, foreign: Path) -> None:
    (folder / "certificate.pem").write_text("-----BEGIN CERTIFICATE-----\nAAAA\n-----END CERTIFICATE-----\n")


def spoil_text(folder: Path, foreign: Path) -> None:
    (folder / "key.pem").write_text("no key at all")


def spoil_absent(folder: Path, foreign: Path) -> None:
    (folder / "certificate.pem").unlink()


def spoil_date(folder: Path, foreign: Path) -> None:
    authority = keys._read_authority(folder.parent)
    old = keys._issue("a", authority, keys._alternatives(["127.0.0.1"]), 0)
    (folder / "certificate.pem").write_bytes(keys._pem(old.certificate))
    (folder / "key.pem").write_bytes(keys._private_pem(old.key))


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (spoil_mode, "must be readable by its owner alone; chmod 600"),
        (spoil_key, r"key\.pem must be the key of .*certificate\.pem, but is another"),
        (spoil_authority, r"must be signed by the authority in .*ca\.pem, but is not"),
        (spoil_certificate, r"certificate\.pem is not what `consat keys` writes"),
        (spoil_text, r"key\.pem is not what `consat keys` writes"),
        (spoil_absent, r"certificate\.pem cannot be read: No such file"),
        (spoil_date, "is valid from .* to .* only"),
    ],
)
def test_unfit_credentials_are_refused_in_words(spoil: Callable[[Path, Path], None], words: str, tmp_path: Path, foreign: Path) -> None:
    keys.make(["a"], tmp_path)
    keys.load(tmp_path, "a")
    spoil(tmp_path / "a", foreign)
    with pytest.raises(NetworkError, match=words):
        keys.load(tmp_path, "a")


def test_another_agents_credentials_are_refused(home: Path) -> None:
    with pytest.raises(NetworkError, match="must be of agent 'a', but is of 'b'"):
        keys.load(home / "b", "a")
    with pytest.raises(NetworkError, match=r"no keys of agent 'z' in .*; make some: consat keys z --out"):
        keys.load(home, "z")


def test_an_authority_without_its_key_cannot_grow_the_team(tmp_path: Path) -> None:
    keys.make(["a"], tmp_path)
    (tmp_path / "ca-key.pem").unlink()
    with pytest.raises(NetworkError, match=r"ca-key\.pem cannot be read"):
        keys.make(["b"], tmp_path)


@pytest.mark.parametrize("address", ["", "10.0.0.1:80", "tls/host", "*.local", "-x", "ä.de", "1.2.3"])
def test_addresses_that_cannot_be_are_refused(address: str, tmp_path: Path) -> None:
    with pytest.raises(NetworkError, match="an address must be"):
        keys.make(["a"], tmp_path / "new", addresses=[address])
    assert not (tmp_path / "new").exists()


@given(st.text(min_size=1, max_size=30))
def test_no_agents_folder_is_one_of_the_authoritys_files_or_elsewhere(name: str) -> None:
    folder = spelled(name)
    assert folder not in {CA, CA_KEY, KEY, CERTIFICATE, ".", ".."}
    assert "/" not in folder


def test_command_makes_keys_of_a_scenario_and_of_ids(tmp_path: Path) -> None:
    run = CliRunner().invoke
    done = run(keys_command, ["case-c", "--out", str(tmp_path / "k")])
    assert done.exit_code == 0, done.output
    assert "keys of 3 agents" in done.output
    assert "ca-key.pem" in done.output
    assert sorted(path.name for path in (tmp_path / "k").iterdir()) == ["a1", "a2", "a3", "ca-key.pem", "ca.pem"]
    done = run(keys_command, ["a4", "a5", "a4", "--out", str(tmp_path / "k"), "--address", "10.1.2.3", "--days", "7"])
    assert done.exit_code == 0, done.output
    keys.load(tmp_path / "k", "a5")
    again = run(keys_command, ["a4", "--out", str(tmp_path / "k")])
    assert isinstance(again.exception, NetworkError)
    assert run(keys_command, ["a4", "--out", str(tmp_path / "k"), "--replace"]).exit_code == 0
    assert run(keys_command, ["--out", str(tmp_path / "k")]).exit_code == 2
    assert run(keys_command, ["a", "b", "--set", "count=2", "--out", str(tmp_path / "k")]).exit_code == 2


def test_keys_beside_the_scenario_are_used_and_must_be_complete(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Nobody goes unprotected because a key is missing."""
    file = tmp_path / "team.yaml"
    file.touch()
    assert commands._keys(None, str(file), ["a", "b"]) is None
    assert commands._keys(None, "case-c", ["a1"]) is None, "a packaged scenario has no folder"
    keys.make(["a", "b"], tmp_path / "keys")
    assert commands._keys(None, str(file), ["a", "b"]) == tmp_path / "keys"
    assert "links are protected" in capsys.readouterr().err
    with pytest.raises(NetworkError, match=r"there are keys in .*keys, but none of 'c'; make them"):
        commands._keys(None, str(file), ["a", "b", "c"])
    own = tmp_path / "robot"
    shutil.copytree(tmp_path / "keys" / "b", own / "keys")
    shutil.copy(file, own)
    assert commands._keys(None, str(own / "team.yaml"), ["b"]) == own / "keys"
    assert keys.load(own / "keys", "b").key == own / "keys" / "key.pem"


def test_commands_of_the_documentation_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Those that need no robot."""
    monkeypatch.chdir(tmp_path)
    text = (Path(__file__).parents[2] / "docs" / "security.md").read_text()
    lines = "\n".join(re.findall(r"^```sh\n(.*?)^```$", text, flags=re.MULTILINE | re.DOTALL)).splitlines()
    lines += re.findall(r"`(consat keys [^`]*)`", text)
    commands = [shlex.split(line) for line in lines if line.startswith("consat ")]
    assert len(commands) == 5
    for program, *arguments in commands:
        done = subprocess.run([SCRIPTS / program, *arguments], capture_output=True, text=True, check=False)
        assert done.returncode == 0, (arguments, done.stderr)
    keys.load(tmp_path / "keys", "a4")
    assert (tmp_path / "parts" / "a1.yaml").is_file()
    for path in re.findall(r"(?:keys/\S+\.pem)", text):
        assert (tmp_path / path).is_file(), path
