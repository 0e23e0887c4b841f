"""The keys of a robot: made once, added to later, readable by their owner only."""

import stat
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from coordinator.live_robot.authority import make_credentials
from module_agent.model.errors import UsageError


def certificate(folder: Path, name: str) -> x509.Certificate:
    return x509.load_pem_x509_certificate((folder / f"{name}.pem").read_bytes())


def test_every_party_has_its_own_certificate_by_the_authority(tmp_path: Path) -> None:
    made = make_credentials(tmp_path / "keys", "arm", ["A", "B"], together=[["A", "B"]], days=30)
    authority = certificate(tmp_path / "keys", "authority")
    names = ("coordinator", "observer", "module-A", "module-B", "host-A+B")
    assert made.new == names
    for name in names:
        one = certificate(tmp_path / "keys", name)
        one.verify_directly_issued_by(authority)
        assert one.subject.get_attributes_for_oid(NameOID.COMMON_NAME)[0].value == name
        now = datetime.now(UTC)
        assert timedelta(days=29) < one.not_valid_after_utc - now <= timedelta(days=30)
        uses = one.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value
        assert (ExtendedKeyUsageOID.SERVER_AUTH in uses) == (name == "coordinator")
    keys = [(tmp_path / "keys" / f"{name}.key").read_bytes() for name in (*names, "authority")]
    assert len(set(keys)) == len(keys)


def test_keys_can_be_read_by_their_owner_only(tmp_path: Path) -> None:
    make_credentials(tmp_path / "keys", "arm", ["A"])
    for path in (tmp_path / "keys").glob("*.key"):
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert stat.S_IMODE((tmp_path / "keys").stat().st_mode) == 0o700


def test_a_module_is_added_later_and_the_others_keep_their_keys(tmp_path: Path) -> None:
    make_credentials(tmp_path, "arm", ["A"])
    before = {path.name: path.read_bytes() for path in tmp_path.glob("*.key")}
    added = make_credentials(tmp_path, "arm", ["A", "B"])
    assert added.new == ("module-B",)
    assert [host.serials for host in added.fleet.host] == [("A",), ("B",)]
    assert all((tmp_path / name).read_bytes() == key for name, key in before.items())
    certificate(tmp_path, "module-B").verify_directly_issued_by(certificate(tmp_path, "authority"))


def test_what_cannot_be_certified_is_refused_before_anything_is_made(tmp_path: Path) -> None:
    for serials, robot, why in (
        (["A/B"], "arm", "serial 'A/B' cannot be part of a key"),
        (["A"], "an arm", "robot 'an arm' cannot be part of a key"),
        (["A" * 60], "arm", "at most 64 characters"),
    ):
        with pytest.raises(UsageError, match=why):
            make_credentials(tmp_path / "keys", robot, serials)
    assert not (tmp_path / "keys").exists()


def test_another_robots_folder_and_one_without_the_authority_are_refused(tmp_path: Path) -> None:
    make_credentials(tmp_path, "arm", ["A"])
    with pytest.raises(UsageError, match="has the keys of robot 'arm', not of 'leg'"):
        make_credentials(tmp_path, "leg", ["A"])
    with pytest.raises(UsageError, match=r"for 127.0.0.1, localhost, not for 10.0.0.7"):
        make_credentials(tmp_path, "arm", ["A"], addresses=["10.0.0.7"])
    (tmp_path / "authority.key").unlink()
    with pytest.raises(UsageError, match=r"authority.key: the authority's key is needed"):
        make_credentials(tmp_path, "arm", ["B"])


def test_the_hubs_certificate_names_its_addresses(tmp_path: Path) -> None:
    make_credentials(tmp_path, "arm", ["A"], addresses=["10.0.0.7", "robot.local"])
    names = certificate(tmp_path, "coordinator").extensions.get_extension_for_class(
        x509.SubjectAlternativeName
    )
    assert [str(ip) for ip in names.value.get_values_for_type(x509.IPAddress)] == ["127.0.0.1", "10.0.0.7"]
    assert names.value.get_values_for_type(x509.DNSName) == ["localhost", "robot.local"]
