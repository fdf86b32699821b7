"""Keys and certificates: a certificate authority of the team, and a key and a certificate for each agent.

    DIR/ca.pem, ca-key.pem                          authority; never copy its key: its holder can act as any agent
    DIR/<agent>/ca.pem, certificate.pem, key.pem    copy this folder to the agent, and to no other machine

The agent's id, encoded by `consat.network.names.spelled`, is the name of its folder and the common name of its certificate. Keys are on the
curve P-256. For what the keys protect, and what not, see docs/security.md.
"""

from __future__ import annotations

import datetime
import ipaddress
import os
import secrets
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, NamedTuple, TypeVar

from consat.errors import NetworkError, shown
from consat.network.names import CA, CA_KEY, CERTIFICATE, KEY, spelled

try:
    from cryptography import x509
    from cryptography.exceptions import InvalidSignature, UnsupportedAlgorithm
    from cryptography.hazmat.primitives import hashes
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat, load_pem_private_key
    from cryptography.x509.oid import ExtendedKeyUsageOID
except ImportError:
    raise NetworkError("keys need the library cryptography, which is not installed; pip install 'consat[network]'") from None

LOOPBACK: Final = "127.0.0.1"
DAYS: Final = 365
"""Validity of an agent's certificate, days."""
AUTHORITY_DAYS: Final = 3650
GRACE: Final = datetime.timedelta(days=1)
"""Certificates are valid from this long before their creation, because a robot's clock may be slow."""

T = TypeVar("T")


@dataclass(frozen=True)
class Credentials:
    """Files with which an agent proves its identity and verifies others.

    Attributes:
        ca: certificate of the team's authority.
        certificate: certificate of the agent, signed by the authority.
        key: private key of the agent.
    """

    ca: Path
    certificate: Path
    key: Path


def make(
    ids: Sequence[str], directory: Path, *, addresses: Iterable[str] = (), days: int = DAYS, replace: bool = False
) -> None:  # fmt: skip
    """Make keys and certificates for agents, and the team's authority if the directory has none yet.

    Args:
        ids: ids of the agents.
        directory: directory to write to; see the module for its layout.
        addresses: IP addresses and host names, besides 127.0.0.1, at which agents of this team can be reached.
        days: validity of the agents' certificates, days.
        replace: whether to renew the keys of agents that have some. The authority is never renewed.

    Raises:
        NetworkError: no id is given, an agent has keys already, `days` or an address is invalid, or the authority cannot be used.
    """
    if not ids:
        raise NetworkError("keys must be made for at least one agent; name the agents, or give a scenario")
    folders = {id_: directory / spelled(id_) for id_ in ids}
    taken = [repr(id_) for id_, folder in folders.items() if folder.exists()]
    if taken and not replace:
        raise NetworkError(
            f"{', '.join(taken)}: there are keys in {directory} already; replace them (--replace) or choose another directory"
        )
    if not 0 < days <= AUTHORITY_DAYS:
        raise NetworkError(f"certificates must be valid for 1 to {AUTHORITY_DAYS} days, not {days}")
    names = _alternatives((LOOPBACK, *addresses))
    directory.mkdir(mode=0o700, parents=True, exist_ok=True)
    if (directory / CA).exists() or (directory / CA_KEY).exists():
        authority = _read_authority(directory)
    else:
        authority = _new_authority()
        _write_all(directory, {CA: _pem(authority.certificate), CA_KEY: _private_pem(authority.key)})
    for id_, folder in folders.items():
        pair = _issue(id_, authority, names, days)
        files = {CA: _pem(authority.certificate), CERTIFICATE: _pem(pair.certificate), KEY: _private_pem(pair.key)}
        folder.mkdir(mode=0o700, exist_ok=replace)
        _write_all(folder, files, replace=replace)


def load(directory: Path, id: str) -> Credentials:  # noqa: A002
    """Find and check the credentials of an agent: id, signature, matching key, validity, and permissions of the key file.

    Args:
        directory: directory that `make` wrote, or the agent's own folder.
        id: id of the agent.

    Raises:
        NetworkError: there are no keys, a check fails, or others can read the private key.
    """
    folder = next((folder for folder in (directory / spelled(id), directory) if (folder / KEY).is_file()), None)
    if folder is None:
        raise NetworkError(f"there are no keys of agent {id!r} in {directory}; make some: consat keys {id} --out {directory}")
    found = Credentials(*(folder / name for name in (CA, CERTIFICATE, KEY)))
    if found.key.stat().st_mode & 0o077:
        raise NetworkError(f"{found.key} must be readable by its owner alone; chmod 600 {found.key}")
    authority, certificate = _read(found.ca, x509.load_pem_x509_certificate), _read(found.certificate, x509.load_pem_x509_certificate)
    _match(certificate, found.certificate, _read(found.key, _key), found.key)
    if (name := _common_name(certificate)) != spelled(id):
        raise NetworkError(f"{found.certificate} must be of agent {id!r}, but is of {shown(name)}")
    try:
        certificate.verify_directly_issued_by(authority)
    except (ValueError, TypeError, InvalidSignature):
        raise NetworkError(f"{found.certificate} must be signed by the authority in {found.ca}, but is not") from None
    for path, each in ((found.ca, authority), (found.certificate, certificate)):
        _still_valid(each, path)
    return found


class _Pair(NamedTuple):
    key: ec.EllipticCurvePrivateKey
    certificate: x509.Certificate


def _alternatives(addresses: Iterable[str]) -> list[x509.GeneralName]:
    names: list[x509.GeneralName] = []
    for address in dict.fromkeys(addresses):
        try:
            names.append(x509.IPAddress(ipaddress.ip_address(address)))
        except ValueError:
            if not all(letter.isascii() and (letter.isalnum() or letter in "-.") for letter in address) or not address[:1].isalpha():
                raise NetworkError(f"an address must be an IP address or a host name, without port, not {shown(address)}") from None
            names.append(x509.DNSName(address))
    return names


def _builder(subject: str, issuer: str, key: ec.EllipticCurvePrivateKey, days: float, *, authority: bool) -> x509.CertificateBuilder:
    """The fields that certificates of agents and of the authority have in common."""
    now = datetime.datetime.now(datetime.UTC)
    usage = dict.fromkeys(
        ("content_commitment", "key_encipherment", "data_encipherment", "key_agreement", "encipher_only", "decipher_only"), False
    )
    usage |= {"digital_signature": not authority, "key_cert_sign": authority, "crl_sign": authority}
    return (
        x509.CertificateBuilder()
        .subject_name(_name(subject))
        .issuer_name(_name(issuer))
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - GRACE)
        .not_valid_after(now + datetime.timedelta(days=days))
        .add_extension(x509.BasicConstraints(ca=authority, path_length=0 if authority else None), critical=True)
        .add_extension(x509.KeyUsage(**usage), critical=True)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
    )


def _new_authority() -> _Pair:
    key = ec.generate_private_key(ec.SECP256R1())
    name = f"consat authority {secrets.token_hex(4)}"
    return _Pair(key, _builder(name, name, key, AUTHORITY_DAYS, authority=True).sign(key, hashes.SHA256()))


def _issue(id_: str, authority: _Pair, names: list[x509.GeneralName], days: float) -> _Pair:
    key = ec.generate_private_key(ec.SECP256R1())
    roles = [ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH]
    certificate = (
        _builder(spelled(id_), _common_name(authority.certificate), key, days, authority=False)
        .add_extension(x509.AuthorityKeyIdentifier.from_issuer_public_key(authority.key.public_key()), critical=False)
        .add_extension(x509.ExtendedKeyUsage(roles), critical=False)
        .add_extension(x509.SubjectAlternativeName(names), critical=False)
        .sign(authority.key, hashes.SHA256())
    )
    return _Pair(key, certificate)


def _read_authority(directory: Path) -> _Pair:
    certificate, key = _read(directory / CA, x509.load_pem_x509_certificate), _read(directory / CA_KEY, _key)
    _match(certificate, directory / CA, key, directory / CA_KEY)
    _still_valid(certificate, directory / CA)
    return _Pair(key, certificate)


def _read(path: Path, parse: Callable[[bytes], T]) -> T:
    try:
        return parse(path.read_bytes())
    except OSError as error:
        raise NetworkError(f"{path} cannot be read: {error.strerror}") from None
    except (ValueError, TypeError) as error:
        raise NetworkError(f"{path} is not what `consat keys` writes: {error}") from None


def _key(text: bytes) -> ec.EllipticCurvePrivateKey:
    try:
        key = load_pem_private_key(text, None)
    except UnsupportedAlgorithm as error:
        raise ValueError(str(error)) from None
    if not isinstance(key, ec.EllipticCurvePrivateKey):
        raise TypeError("a private key on the curve P-256 is due")
    return key


def _match(certificate: x509.Certificate, certificate_path: Path, key: ec.EllipticCurvePrivateKey, key_path: Path) -> None:
    if certificate.public_key() != key.public_key():
        raise NetworkError(f"{key_path} must be the key of {certificate_path}, but is another")


def _still_valid(certificate: x509.Certificate, path: Path) -> None:
    now = datetime.datetime.now(datetime.UTC)
    if not certificate.not_valid_before_utc <= now <= certificate.not_valid_after_utc:
        first, last = (f"{end:%Y-%m-%d}" for end in (certificate.not_valid_before_utc, certificate.not_valid_after_utc))
        raise NetworkError(f"{path} is valid from {first} to {last} only, and by this machine's clock it is {now:%Y-%m-%d}")


def _name(common: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, common)])


def _common_name(certificate: x509.Certificate) -> str:
    names = certificate.subject.get_attributes_for_oid(x509.NameOID.COMMON_NAME)
    return str(names[0].value) if names else ""


def _pem(certificate: x509.Certificate) -> bytes:
    return certificate.public_bytes(Encoding.PEM)


def _private_pem(key: ec.EllipticCurvePrivateKey) -> bytes:
    return key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())


def _write_all(folder: Path, files: dict[str, bytes], *, replace: bool = False) -> None:
    """Write files. Private keys are created with owner-only permissions, before the first byte is written.

    With `replace`, each file is written under another name and then renamed, so that no reader finds a part of it.
    """
    for name, content in files.items():
        path = folder / name
        fresh = path.with_suffix(".new") if replace else path
        mode = 0o600 if name in {KEY, CA_KEY} else 0o644
        if replace:
            fresh.unlink(missing_ok=True)
        with os.fdopen(os.open(fresh, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb") as file:
            file.write(content)
        if replace:
            fresh.replace(path)
