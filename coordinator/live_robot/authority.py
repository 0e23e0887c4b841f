"""A small certificate authority for one robot: keys and certificates of its hosts, coordinator and observers.

The authority's own key stays in the folder: with it modules are added later. With it a
certificate of every party can be made; it belongs on no module.
"""

import os
from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from ipaddress import ip_address
from pathlib import Path
from typing import NamedTuple

from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from module_agent.model.errors import UsageError
from module_agent.model.files import replacing, write_text
from module_agent.transport.credentials import (
    AUTHORITY,
    COORDINATOR,
    FLEET,
    OBSERVER,
    Fleet,
    Host,
    load_fleet,
)
from module_agent.wire.keys import check_chunk

LOOPBACK = ("127.0.0.1", "localhost")
DAYS = 3650
# X.509 allows a common name of 64 characters.
_PREFIX = "module-"
_MAX_SERIAL = 64 - len(_PREFIX)
# A module whose clock is behind must not refuse a certificate of today.
_BACKDATED = timedelta(days=1)


class Made(NamedTuple):
    """What was made in a folder: the fleet, and the names whose certificates are new."""

    fleet: Fleet
    new: tuple[str, ...]


class _Authority(NamedTuple):
    """The key and certificate by which others are certified."""

    key: ec.EllipticCurvePrivateKey
    certificate: x509.Certificate


def make_credentials(
    folder: Path,
    robot: str,
    serials: Sequence[str],
    together: Sequence[Sequence[str]] = (),
    addresses: Sequence[str] = (),
    days: int = DAYS,
) -> Made:
    """Make the credentials of a robot in a folder, or add what a folder does not have yet.

    Args:
        folder: made if it is missing; only its owner can read the keys.
        robot: its name, part of every key.
        serials: of modules, each of which gets a certificate of its own.
        together: serials of modules that run in one process, with one certificate.
        addresses: names and IP addresses of the hub, besides those of this machine's loopback.
        days: how long the certificates are valid.

    Raises:
        UsageError: a serial cannot be; the folder is another robot's, has no authority's key, or has a hub
            with other addresses.
    """
    check_chunk("robot", robot)
    hosts = [_host(_PREFIX + serial, (serial,)) for serial in serials]
    hosts += [_host("host-" + "+".join(group), tuple(group)) for group in together]
    folder.mkdir(parents=True, exist_ok=True, mode=0o700)
    if (folder / FLEET).exists():
        before = load_fleet(folder)
        if before.robot != robot:
            raise UsageError(f"{folder} has the keys of robot {before.robot!r}, not of {robot!r}")
        if missing := [each for each in addresses if each not in before.addresses]:
            raise UsageError(
                f"{folder}: the hub's certificate is for {', '.join(before.addresses)}, not for "
                f"{missing[0]}: make the keys anew in another folder"
            )
        authority = _load_authority(folder)
    else:
        before = Fleet(robot=robot, addresses=(*LOOPBACK, *addresses), host=())
        authority = _new_authority(folder, robot, days)
    known = {host.name: host for host in before.host}
    fleet = before.model_copy(update={"host": tuple((known | {h.name: h for h in hosts}).values())})
    new = [name for name in (COORDINATOR, OBSERVER, *(h.name for h in hosts)) if not _has(folder, name)]
    for name in new:
        _certify(folder, authority, name, fleet.addresses if name == COORDINATOR else (), days)
    # Last: a folder with a description has everything that it describes.
    write_text(folder / FLEET, _description(fleet))
    return Made(fleet, tuple(new))


def _host(name: str, serials: tuple[str, ...]) -> Host:
    for serial in serials:
        check_chunk("serial", serial)
    if len(name) > 64:
        raise UsageError(
            f"{name}: a certificate's name has at most 64 characters, so a serial at most {_MAX_SERIAL}; "
            "give a host of many modules several processes"
        )
    return Host(name=name, serials=serials)


def _has(folder: Path, name: str) -> bool:
    return (folder / f"{name}.pem").exists() and (folder / f"{name}.key").exists()


def _name(text: str) -> x509.Name:
    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, text)])


def _new_authority(folder: Path, robot: str, days: int) -> _Authority:
    key, name = ec.generate_private_key(ec.SECP256R1()), _name(f"x5 authority of {robot}"[:64])
    now = datetime.now(UTC)
    certificate = (
        x509.CertificateBuilder(name, name, key.public_key(), x509.random_serial_number())
        .not_valid_before(now - _BACKDATED)
        .not_valid_after(now + timedelta(days=days))
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .sign(key, hashes.SHA256())
    )
    _write_pair(folder, AUTHORITY, key, certificate)
    return _Authority(key, certificate)


def _load_authority(folder: Path) -> _Authority:
    path = folder / f"{AUTHORITY}.key"
    try:
        key = serialization.load_pem_private_key(path.read_bytes(), None)
        certificate = x509.load_pem_x509_certificate((folder / f"{AUTHORITY}.pem").read_bytes())
    except (OSError, ValueError, TypeError) as error:
        raise UsageError(f"{path}: the authority's key is needed to certify more modules: {error}") from error
    if not isinstance(key, ec.EllipticCurvePrivateKey):
        raise UsageError(f"{path}: not a key of an elliptic curve")
    return _Authority(key, certificate)


def _certify(folder: Path, authority: _Authority, name: str, addresses: Sequence[str], days: int) -> None:
    """Make a key and its certificate; only one with addresses is good for a hub."""
    key, now = ec.generate_private_key(ec.SECP256R1()), datetime.now(UTC)
    uses = [ExtendedKeyUsageOID.CLIENT_AUTH, *([ExtendedKeyUsageOID.SERVER_AUTH] if addresses else [])]
    # TLS libraries refuse a certificate without any alternative name.
    names = [_alternative(each) for each in addresses] or [x509.DNSName("no-server.invalid")]
    certificate = (
        x509.CertificateBuilder(
            authority.certificate.subject, _name(name), key.public_key(), x509.random_serial_number()
        )
        .not_valid_before(now - _BACKDATED)
        .not_valid_after(min(now + timedelta(days=days), authority.certificate.not_valid_after_utc))
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(x509.ExtendedKeyUsage(uses), critical=False)
        .add_extension(x509.SubjectAlternativeName(names), critical=False)
        .sign(authority.key, hashes.SHA256())
    )
    _write_pair(folder, name, key, certificate)


def _alternative(address: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ip_address(address))
    except ValueError:
        pass
    try:
        return x509.DNSName(address)
    except ValueError as error:
        raise UsageError(f"address {address!r}: neither an IP address nor a name: {error}") from error


def _write_pair(
    folder: Path, name: str, key: ec.EllipticCurvePrivateKey, certificate: x509.Certificate
) -> None:
    secret = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    _write(folder / f"{name}.key", secret, 0o600)
    _write(folder / f"{name}.pem", certificate.public_bytes(serialization.Encoding.PEM), 0o644)


def _write(path: Path, data: bytes, mode: int) -> None:
    """Write a file that is at no time readable by more than `mode` says."""
    with replacing(path) as temporary:
        temporary.unlink(missing_ok=True)
        with open(os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb") as file:
            file.write(data)


def _description(fleet: Fleet) -> str:
    def listed(values: Sequence[str]) -> str:
        return "[" + ", ".join(f'"{value}"' for value in values) + "]"

    lines = [f'robot = "{fleet.robot}"', f"addresses = {listed(fleet.addresses)}"]
    for host in fleet.host:
        lines += ["", "[[host]]", f'name = "{host.name}"', f"serials = {listed(host.serials)}"]
    return "\n".join(lines) + "\n"
