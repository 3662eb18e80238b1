"""The server's own authority: what robots pin, and a certificate that renews itself."""

from __future__ import annotations

from pathlib import Path

import pytest

from amberbox.core.errors import AmberboxError, UsageError
from amberbox.server import certificates
from amberbox.server.certificates import (
    CertificateFiles,
    days_left,
    fingerprint,
    make,
    names_of,
    renew,
)

DAY_NS = 24 * 3600 * 10**9
NOW_NS = 1_800_000_000 * 10**9


def test_keys_are_for_the_servers_user_only(tmp_path: Path) -> None:
    make(tmp_path, ["fleet.example"], NOW_NS)
    files = CertificateFiles(tmp_path)
    modes = [path.stat().st_mode & 0o777 for path in (files.authority_key, files.server_key)]
    assert modes == [0o600, 0o600]
    assert files.server.parent.stat().st_mode & 0o777 == 0o700


def test_the_authority_lasts_ten_years_the_certificate_one(tmp_path: Path) -> None:
    make(tmp_path, ["fleet.example"], NOW_NS)
    files = CertificateFiles(tmp_path)
    assert days_left(files.authority, NOW_NS) == 3650
    assert days_left(files.server, NOW_NS) == 365


def test_a_certificate_says_what_it_is_for(tmp_path: Path) -> None:
    from cryptography import x509
    from cryptography.x509.oid import ExtendedKeyUsageOID

    make(tmp_path, ["fleet.example"], NOW_NS)
    files = CertificateFiles(tmp_path)
    server, authority = (
        x509.load_pem_x509_certificate(path.read_bytes())
        for path in (files.server, files.authority)
    )
    uses = server.extensions.get_extension_for_class(x509.ExtendedKeyUsage).value
    assert list(uses) == [ExtendedKeyUsageOID.SERVER_AUTH]
    assert not server.extensions.get_extension_for_class(x509.BasicConstraints).value.ca
    held = authority.extensions.get_extension_for_class(x509.BasicConstraints).value
    assert held.ca and held.path_length == 0
    server.verify_directly_issued_by(authority)


def test_it_is_made_anew_with_less_than_sixty_days_left(tmp_path: Path) -> None:
    make(tmp_path, ["fleet.example", "192.0.2.1"], NOW_NS)
    pin, files = fingerprint(tmp_path), CertificateFiles(tmp_path)
    assert not renew(tmp_path, NOW_NS + 300 * DAY_NS)
    later_ns = NOW_NS + 306 * DAY_NS
    assert renew(tmp_path, later_ns)
    assert days_left(files.server, later_ns) == 365
    assert names_of(tmp_path) == ("fleet.example", "192.0.2.1")
    assert fingerprint(tmp_path) == pin, "robots have pinned it"


def test_another_name_keeps_the_authority(tmp_path: Path) -> None:
    make(tmp_path, ["fleet.example"], NOW_NS)
    pin = fingerprint(tmp_path)
    assert make(tmp_path, ["Fleet.Example", "new.example", "::1"], NOW_NS)[1:] == (
        "new.example",
        "::1",
    )
    assert fingerprint(tmp_path) == pin


def test_no_certificate_outlives_its_authority(tmp_path: Path) -> None:
    make(tmp_path, ["fleet.example"], NOW_NS)
    late_ns = NOW_NS + 3600 * DAY_NS
    renew(tmp_path, late_ns)
    assert days_left(CertificateFiles(tmp_path).server, late_ns) == 50
    with pytest.raises(AmberboxError, match="is over"):
        make(tmp_path, ["fleet.example"], NOW_NS + 3650 * DAY_NS)


@pytest.mark.parametrize("name", ["", "a b", "0.0.0.0", "*.example", "-x", "a" * 300, "x;y"])
def test_what_is_no_name_is_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(UsageError):
        make(tmp_path, [name], NOW_NS)


def test_a_key_that_is_gone_is_told(tmp_path: Path) -> None:
    make(tmp_path, ["fleet.example"], NOW_NS)
    CertificateFiles(tmp_path).authority_key.unlink()
    with pytest.raises(AmberboxError, match="cannot be read"):
        certificates.make(tmp_path, ["fleet.example"], NOW_NS)
