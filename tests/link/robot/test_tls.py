"""TLS with a pinned authority, independent of the date."""

from __future__ import annotations

import datetime
import socket
import ssl
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives import serialization as form
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID

from amberbox.core.errors import UsageError
from amberbox.core.tls import PinError, fingerprint, normal_fingerprint
from amberbox.link.connection import CA_FILE, tls_context
from amberbox.testing.clock import PATIENCE_S

LONG_AGO = datetime.datetime(2001, 1, 1, tzinfo=datetime.UTC)
DAY = datetime.timedelta(days=1)


def _certificate(
    name: str, key: ec.EllipticCurvePrivateKey, by: tuple[x509.Name, ec.EllipticCurvePrivateKey]
) -> x509.Certificate:
    """Make a certificate that has been over for years: as a clock of 1970 or 2070 sees any."""
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
    builder = (
        x509.CertificateBuilder(by[0], subject, key.public_key(), x509.random_serial_number())
        .not_valid_before(LONG_AGO)
        .not_valid_after(LONG_AGO + DAY)
        .add_extension(x509.BasicConstraints(ca=name == "ca", path_length=None), critical=True)
        .add_extension(x509.SubjectAlternativeName([x509.DNSName(name)]), critical=False)
    )
    return builder.sign(by[1], hashes.SHA256())


class Authority:
    """A small local authority and a server's certificate by it."""

    def __init__(self, folder: Path, host: str = "localhost") -> None:
        folder.mkdir()
        self.key, server = (ec.generate_private_key(ec.SECP256R1()) for _ in range(2))
        name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "ca")])
        ca = _certificate("ca", self.key, (name, self.key))
        leaf = _certificate(host, server, (name, self.key))
        self.pem = ca.public_bytes(form.Encoding.PEM)
        self.chain, self.private = folder / "chain.pem", folder / "key.pem"
        self.chain.write_bytes(leaf.public_bytes(form.Encoding.PEM) + self.pem)
        self.private.write_bytes(
            server.private_bytes(form.Encoding.PEM, form.PrivateFormat.PKCS8, form.NoEncryption())
        )


@contextmanager
def served(authority: Authority) -> Iterator[int]:
    """Serve the authority's certificate over TLS, without authentication."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(authority.chain, authority.private)
    listener = socket.create_server(("127.0.0.1", 0))

    def run() -> None:
        while True:
            try:
                plain, _ = listener.accept()
                with context.wrap_socket(plain, server_side=True) as secure:
                    if secure.recv(4096):
                        secure.sendall(b"HTTP/1.0 200 OK\r\n\r\n" + authority.pem)
            except ssl.SSLError:
                continue  # a client that does not trust us
            except OSError:
                return

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    yield listener.getsockname()[1]
    listener.shutdown(socket.SHUT_RDWR)
    listener.close()
    thread.join(PATIENCE_S)


def shake_hands(port: int, context: ssl.SSLContext, name: str = "localhost") -> None:
    with (
        socket.create_connection(("127.0.0.1", port), PATIENCE_S) as plain,
        context.wrap_socket(plain, server_hostname=name),
    ):
        pass


def test_a_pinned_server_is_trusted_whatever_the_date(tmp_path: Path) -> None:
    authority = Authority(tmp_path / "a")
    pin = "SHA256:" + fingerprint(authority.pem).upper()
    with served(authority) as port:
        url = f"https://localhost:{port}"
        context = tls_context(url, pin, tmp_path)
        assert context is not None
        shake_hands(port, context)
        assert (tmp_path / CA_FILE).read_bytes() == authority.pem
    assert tls_context("https://localhost:1", pin, tmp_path) is not None  # it is known by now


def test_another_authority_is_not(tmp_path: Path) -> None:
    ours, theirs = Authority(tmp_path / "a"), Authority(tmp_path / "b")
    pin = fingerprint(ours.pem)
    with served(ours) as port:
        context = tls_context(f"https://localhost:{port}", pin, tmp_path)
    assert context is not None
    with served(theirs) as port:
        with pytest.raises(ssl.SSLCertVerificationError):
            shake_hands(port, context)
        with pytest.raises(PinError, match="right server"):
            tls_context(f"https://localhost:{port}", "00" * 32, tmp_path)


def test_the_name_has_to_be_the_server_s(tmp_path: Path) -> None:
    authority = Authority(tmp_path / "a", "other")
    with served(authority) as port:
        context = tls_context(f"https://localhost:{port}", fingerprint(authority.pem), tmp_path)
        assert context is not None
        with pytest.raises(ssl.SSLCertVerificationError):
            shake_hands(port, context)


def test_a_pin_is_64_digits() -> None:
    assert normal_fingerprint("AB:" * 31 + "ab") == "ab" * 32
    with pytest.raises(UsageError):
        normal_fingerprint("abc")
