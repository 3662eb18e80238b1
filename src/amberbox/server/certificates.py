"""TLS certificates: the server's own certificate authority, and the certificate that it signs."""

from __future__ import annotations

import datetime as dt
import hashlib
import ipaddress
import re
import ssl
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from amberbox.core.clock import NS
from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.files import write_private

if TYPE_CHECKING:
    from cryptography import x509
    from cryptography.hazmat.primitives.asymmetric.ec import EllipticCurvePrivateKey


# Folder of the server's own certificate authority, below the data folder
CERTIFICATE = Path("tls") / "ca.pem"


def fingerprint(folder: Path) -> str:
    """Return the SHA-256 of the authority's certificate, 64 hex digits; empty without one."""
    path = folder / CERTIFICATE
    if not path.is_file():
        return ""
    der = ssl.PEM_cert_to_DER_cert(path.read_text(encoding="ascii").strip() + "\n")
    return hashlib.sha256(der).hexdigest()


FOLDER = "tls"
_AUTHORITY_DAYS = 3650
_SERVER_DAYS = 365
_RENEW_DAYS = 60
# Certificates are valid from one day before their creation, since clocks differ
_BEFORE = dt.timedelta(days=1)
_LABEL = r"[a-z0-9](?:[a-z0-9-]{0,61}[a-z0-9])?"
_NAME = re.compile(rf"(?=.{{1,253}}$){_LABEL}(?:\.{_LABEL})*")


@dataclass(frozen=True, slots=True)
class CertificateFiles:
    """Paths of the certificates in a data folder; keys are readable by the server's user only."""

    folder: Path

    @property
    def authority(self) -> Path:
        """The authority's certificate, which is public."""
        return self.folder / FOLDER / "ca.pem"

    @property
    def authority_key(self) -> Path:
        """The authority's private key."""
        return self.folder / FOLDER / "ca.key"

    @property
    def server(self) -> Path:
        """The server's certificate, followed by the authority's."""
        return self.folder / FOLDER / "server.pem"

    @property
    def server_key(self) -> Path:
        """The server's private key."""
        return self.folder / FOLDER / "server.key"

    @property
    def are_there(self) -> bool:
        """Return whether there is a server certificate with its key."""
        return self.server.is_file() and self.server_key.is_file()


def checked_names(names: Sequence[str]) -> tuple[str, ...]:
    """Return host names and addresses in normal form, each once; raises UsageError for others."""
    found = dict.fromkeys(_checked(name) for name in names)
    if not found:
        raise UsageError("a certificate needs a name", "--host fleet.example, as robots call it")
    return tuple(found)


def make(folder: Path, names: Sequence[str], now_ns: int) -> tuple[str, ...]:
    """Create a server certificate for names, and the authority if there is none; return the names.

    An existing authority is kept, so that robots that pinned it still trust the server. Raises
    UsageError for a wrong name, AmberboxError when the authority cannot be used.
    """
    files, names = CertificateFiles(folder), checked_names(names)
    files.server.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    if not files.authority.exists():
        _make_authority(files, now_ns)
    _make_server(files, names, now_ns)
    return names


def names_of(folder: Path) -> tuple[str, ...]:
    """Return the names in the server's certificate; the first is its main name."""
    from cryptography import x509

    kind = x509.SubjectAlternativeName
    found = (
        _read_certificate(CertificateFiles(folder).server)
        .extensions.get_extension_for_class(kind)
        .value
    )
    return tuple(str(name.value) for name in found)


def days_left(path: Path, now_ns: int) -> float:
    """Return for how many more days a certificate is valid."""
    left = _read_certificate(path).not_valid_after_utc - _moment(now_ns)
    return left / dt.timedelta(days=1)


def renew(folder: Path, now_ns: int) -> bool:
    """Renew the server's certificate if it is valid for less than 60 days; return whether it was.

    Raises AmberboxError when the authority has expired or its key is missing.
    """
    files = CertificateFiles(folder)
    if days_left(files.server, now_ns) >= _RENEW_DAYS:
        return False
    _make_server(files, names_of(folder), now_ns)
    return True


def _make_authority(files: CertificateFiles, now_ns: int) -> None:
    from cryptography import x509

    key = _new_key()
    subject = _subject("Amberbox authority")
    builder = _builder(subject, subject, key, now_ns, _AUTHORITY_DAYS)
    builder = builder.add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
    builder = builder.add_extension(_usage(signs=True), critical=True)
    write_private(files.authority_key, _key_text(key))
    write_private(files.authority, _text(_signed(builder, key)), mode=0o644)


def _make_server(files: CertificateFiles, names: Sequence[str], now_ns: int) -> None:
    from cryptography import x509
    from cryptography.x509.oid import ExtendedKeyUsageOID

    authority, authority_key = _read_authority(files)
    if days_left(files.authority, now_ns) <= 1:
        raise AmberboxError(
            f"the authority {files.authority} is over",
            f"delete {files.authority.parent}, make a new one, and add the robots again",
        )
    days = min(float(_SERVER_DAYS), days_left(files.authority, now_ns))
    key = _new_key()
    builder = _builder(_subject(names[0][:64]), authority.subject, key, now_ns, days)
    builder = builder.add_extension(_alternative(names), critical=False)
    builder = builder.add_extension(x509.BasicConstraints(ca=False, path_length=None), True)
    builder = builder.add_extension(_usage(signs=False), critical=True)
    builder = builder.add_extension(
        x509.ExtendedKeyUsage([ExtendedKeyUsageOID.SERVER_AUTH]), critical=False
    )
    issuer = x509.AuthorityKeyIdentifier.from_issuer_public_key(authority_key.public_key())
    builder = builder.add_extension(issuer, critical=False)
    certificate = _text(_signed(builder, authority_key)) + files.authority.read_text()
    write_private(files.server_key, _key_text(key))
    write_private(files.server, certificate, mode=0o644)


def _builder(
    subject: x509.Name, issuer: x509.Name, key: EllipticCurvePrivateKey, now_ns: int, days: float
) -> x509.CertificateBuilder:
    from cryptography import x509

    now = _moment(now_ns)
    builder = x509.CertificateBuilder(issuer, subject, key.public_key())
    builder = builder.serial_number(x509.random_serial_number())
    builder = builder.not_valid_before(now - _BEFORE).not_valid_after(now + dt.timedelta(days=days))
    own = x509.SubjectKeyIdentifier.from_public_key(key.public_key())
    return builder.add_extension(own, critical=False)


def _usage(*, signs: bool) -> x509.KeyUsage:
    from cryptography import x509

    return x509.KeyUsage(
        digital_signature=not signs, key_cert_sign=signs, crl_sign=signs, content_commitment=False,
        key_encipherment=False, data_encipherment=False, key_agreement=False,
        encipher_only=False, decipher_only=False,
    )  # fmt: skip


def _alternative(names: Sequence[str]) -> x509.SubjectAlternativeName:
    from cryptography import x509

    found: list[x509.GeneralName] = []
    for name in names:
        address = _address(name)
        found.append(x509.DNSName(name) if address is None else x509.IPAddress(address))
    return x509.SubjectAlternativeName(found)


def _subject(name: str) -> x509.Name:
    from cryptography import x509
    from cryptography.x509.oid import NameOID

    return x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])


def _new_key() -> EllipticCurvePrivateKey:
    from cryptography.hazmat.primitives.asymmetric import ec

    return ec.generate_private_key(ec.SECP256R1())


def _signed(builder: x509.CertificateBuilder, key: EllipticCurvePrivateKey) -> x509.Certificate:
    from cryptography.hazmat.primitives import hashes

    return builder.sign(key, hashes.SHA256())


def _read_authority(files: CertificateFiles) -> tuple[x509.Certificate, EllipticCurvePrivateKey]:
    from cryptography.hazmat.primitives.asymmetric.ec import EllipticCurvePrivateKey
    from cryptography.hazmat.primitives.serialization import load_pem_private_key

    try:
        key = load_pem_private_key(files.authority_key.read_bytes(), None)
    except (OSError, ValueError, TypeError) as error:
        raise AmberboxError(
            f"the authority's key {files.authority_key} cannot be read: {error}",
            "restore it from a copy; without it no certificate can be made",
        ) from error
    if not isinstance(key, EllipticCurvePrivateKey):
        raise AmberboxError(f"{files.authority_key} is a key of another kind", "restore the file")
    return _read_certificate(files.authority), key


def _read_certificate(path: Path) -> x509.Certificate:
    from cryptography import x509

    try:
        return x509.load_pem_x509_certificate(path.read_bytes())
    except (OSError, ValueError) as error:
        raise AmberboxError(
            f"the certificate {path} cannot be read: {error}",
            "amberbox serve cert --data DIR --host NAME makes a new one",
        ) from error


def _text(certificate: x509.Certificate) -> str:
    from cryptography.hazmat.primitives.serialization import Encoding

    return certificate.public_bytes(Encoding.PEM).decode("ascii")


def _key_text(key: EllipticCurvePrivateKey) -> str:
    from cryptography.hazmat.primitives.serialization import (
        Encoding,
        NoEncryption,
        PrivateFormat,
    )

    form = PrivateFormat.PKCS8
    return key.private_bytes(Encoding.PEM, form, NoEncryption()).decode("ascii")


def _checked(name: str) -> str:
    plain = name.strip().lower().removeprefix("[").removesuffix("]")
    address = _address(plain)
    if address is not None and not address.is_unspecified:
        return str(address)
    if address is not None or not _NAME.fullmatch(plain):
        raise UsageError(
            f"'{name}' is no name and no address of a computer",
            "--host takes what robots and browsers call the server, such as fleet.example",
        )
    return plain


def _address(text: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        return ipaddress.ip_address(text)
    except ValueError:
        return None


def _moment(now_ns: int) -> dt.datetime:
    return dt.datetime.fromtimestamp(now_ns // NS, dt.UTC)
