"""A team's own certificate authority, and for each agent a key and a certificate by which the others know it.

    DIR/ca.pem, ca-key.pem                          the authority: its key stays where it was made, for who has it can be anybody
    DIR/<agent>/ca.pem, certificate.pem, key.pem    goes to the agent, and nowhere else

The agent's id, as `consat.network.names.spelled` writes it, is the name of its folder and the common name of its certificate. Keys are on
the curve P-256. What they protect and what they don't: docs/security.md.
"""

from __future__ import annotations

import datetime
import ipaddress
import os
import secrets
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple, TypeVar

from consat.errors import NetworkError, shown
from consat.network.names import spelled

if TYPE_CHECKING:
    from cryptography import x509
    from cryptography.hazmat.primitives.asymmetric.ec import EllipticCurvePrivateKey

CA: Final = "ca.pem"
CA_KEY: Final = "ca-key.pem"
CERTIFICATE: Final = "certificate.pem"
KEY: Final = "key.pem"
"""No folder of an agent can be called like one of these: names as `spelled` have no dot."""
LOOPBACK: Final = "127.0.0.1"
DAYS: Final = 365
"""For which an agent's certificate is valid."""
AUTHORITY_DAYS: Final = 3650
GRACE: Final = datetime.timedelta(days=1)
"""Certificates are valid from so long ago: a robot's clock may be slow."""

T = TypeVar("T")


@dataclass(frozen=True)
class Credentials:
    """What an agent shows to prove who it is, and by what it tells who others are.

    Attributes:
        ca: certificate of the team's authority.
        certificate: the agent's own, which the authority signed.
        key: its private key.
    """

    ca: Path
    certificate: Path
    key: Path


def make(
    ids: Sequence[str], directory: Path, *, addresses: Iterable[str] = (), days: int = DAYS, replace: bool = False
) -> None:  # fmt: skip
    """Make keys and certificates for agents, and the team's authority where the directory has none yet.

    Args:
        ids: of the agents.
        directory: see the module.
        addresses: IP addresses and host names, besides 127.0.0.1, at which agents of this team can be reached.
        days: for which the agents' certificates are valid.
        replace: renew the keys of agents that have some; the authority always stays.

    Raises:
        NetworkError: an agent has keys already, an address cannot be one, or the authority cannot be used.
    """
    _require_cryptography()
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
    """The credentials of an agent, which are looked at first: they are its own, belong together, and are valid now.

    Args:
        directory: as `make` wrote it, or the agent's own folder.
        id: of the agent.

    Raises:
        NetworkError: one of these is not so, or others can read the private key.
    """
    _require_cryptography()
    folder = next((folder for folder in (directory / spelled(id), directory) if (folder / KEY).is_file()), None)
    if folder is None:
        raise NetworkError(f"there are no keys of agent {id!r} in {directory}; make some: consat keys {id} --out {directory}")
    found = Credentials(*(folder / name for name in (CA, CERTIFICATE, KEY)))
    if found.key.stat().st_mode & 0o077:
        raise NetworkError(f"{found.key} must be readable by its owner alone; chmod 600 {found.key}")
    authority, certificate = _read(found.ca, _certificate), _read(found.certificate, _certificate)
    _match(certificate, found.certificate, _read(found.key, _key), found.key)
    if (name := _common_name(certificate)) != spelled(id):
        raise NetworkError(f"{found.certificate} must be of agent {id!r}, but is of {shown(name)}")
    try:
        certificate.verify_directly_issued_by(authority)
    except (ValueError, TypeError, _invalid_signature()):
        raise NetworkError(f"{found.certificate} must be signed by the authority in {found.ca}, but is not") from None
    for path, each in ((found.ca, authority), (found.certificate, certificate)):
        _still_valid(each, path)
    return found


class _Pair(NamedTuple):
    key: EllipticCurvePrivateKey
    certificate: x509.Certificate


def _require_cryptography() -> None:
    try:
        import cryptography  # noqa: F401
    except ImportError:
        raise NetworkError("keys need the library cryptography, which is not installed; pip install 'consat[network]'") from None


def _alternatives(addresses: Iterable[str]) -> list[x509.GeneralName]:
    from cryptography import x509

    names: list[x509.GeneralName] = []
    for address in dict.fromkeys(addresses):
        try:
            names.append(x509.IPAddress(ipaddress.ip_address(address)))
        except ValueError:
            if not all(letter.isascii() and (letter.isalnum() or letter in "-.") for letter in address) or not address[:1].isalpha():
                raise NetworkError(f"an address must be an IP address or a host name, without port, not {shown(address)}") from None
            names.append(x509.DNSName(address))
    return names


def _builder(subject: str, issuer: str, key: EllipticCurvePrivateKey, days: float, *, authority: bool) -> x509.CertificateBuilder:
    """What certificates of agents and of the authority have in common."""
    from cryptography import x509

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
    from cryptography.hazmat.primitives import hashes
    from cryptography.hazmat.primitives.asymmetric import ec

    key = ec.generate_private_key(ec.SECP256R1())
    name = f"consat authority {secrets.token_hex(4)}"
    return _Pair(key, _builder(name, name, key, AUTHORITY_DAYS, authority=True).sign(key, hashes.SHA256()))


def _issue(id_: str, authority: _Pair, names: list[x509.GeneralName], days: float) -> _Pair:
    from cryptography import x509
    from cryptography.hazmat.primitives import hashes
    from cryptography.hazmat.primitives.asymmetric import ec
    from cryptography.x509.oid import ExtendedKeyUsageOID

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
    certificate, key = _read(directory / CA, _certificate), _read(directory / CA_KEY, _key)
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


def _certificate(text: bytes) -> x509.Certificate:
    from cryptography import x509

    return x509.load_pem_x509_certificate(text)


def _key(text: bytes) -> EllipticCurvePrivateKey:
    from cryptography.exceptions import UnsupportedAlgorithm
    from cryptography.hazmat.primitives.asymmetric.ec import EllipticCurvePrivateKey
    from cryptography.hazmat.primitives.serialization import load_pem_private_key

    try:
        key = load_pem_private_key(text, None)
    except UnsupportedAlgorithm as error:
        raise ValueError(str(error)) from None
    if not isinstance(key, EllipticCurvePrivateKey):
        raise TypeError("a private key on the curve P-256 is due")
    return key


def _match(certificate: x509.Certificate, certificate_path: Path, key: EllipticCurvePrivateKey, key_path: Path) -> None:
    if certificate.public_key() != key.public_key():
        raise NetworkError(f"{key_path} must be the key of {certificate_path}, but is another")


def _still_valid(certificate: x509.Certificate, path: Path) -> None:
    now = datetime.datetime.now(datetime.UTC)
    if not certificate.not_valid_before_utc <= now <= certificate.not_valid_after_utc:
        first, last = (f"{end:%Y-%m-%d}" for end in (certificate.not_valid_before_utc, certificate.not_valid_after_utc))
        raise NetworkError(f"{path} is valid from {first} to {last} only, and by this machine's clock it is {now:%Y-%m-%d}")


def _invalid_signature() -> type[Exception]:
    from cryptography.exceptions import InvalidSignature

    return InvalidSignature


def _name(common: str) -> x509.Name:
    from cryptography import x509

    return x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, common)])


def _common_name(certificate: x509.Certificate) -> str:
    from cryptography import x509

    names = certificate.subject.get_attributes_for_oid(x509.NameOID.COMMON_NAME)
    return str(names[0].value) if names else ""


def _pem(certificate: x509.Certificate) -> bytes:
    from cryptography.hazmat.primitives.serialization import Encoding

    return certificate.public_bytes(Encoding.PEM)


def _private_pem(key: EllipticCurvePrivateKey) -> bytes:
    from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat

    return key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption())


def _write_all(folder: Path, files: dict[str, bytes], *, replace: bool = False) -> None:
    """Files that only their owner can read, from their first byte on; certificates may be read by all."""
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
