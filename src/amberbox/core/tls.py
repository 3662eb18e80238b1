"""Network peers: loopback addresses, and TLS to a server pinned by its authority's fingerprint.

A pinned server is verified by its certificate chain and name, not by dates: robots without a
battery for their clock start in 1970 and have no time before they have a network.
"""

from __future__ import annotations

import base64
import hashlib
import ipaddress
import re
import socket
import ssl
from urllib.parse import urlsplit

from amberbox.core.errors import AmberboxError, UsageError

CA_PATH = "/link/v1/ca.pem"  # where a server publishes its authority's certificate
_ANOTHER_HINT = "is this the right server? if its authority was made anew, trust it anew"
_NO_CHECK_TIME = 0x200000  # X509_V_FLAG_NO_CHECK_TIME of OpenSSL, which Python's enumeration lacks
_MOST_BYTES = 64 << 10
_TIMEOUT_S = 10.0
_PEM = re.compile(rb"-----BEGIN CERTIFICATE-----\s+([A-Za-z0-9+/=\s]+?)-----END CERTIFICATE-----")


class PinError(AmberboxError):
    """The server's authority is not the one that was pinned."""


def fingerprint(pem: bytes) -> str:
    """Return the SHA-256 of the first certificate of a PEM file, 64 hex digits.

    Raises ValueError when it contains no certificate.
    """
    found = _PEM.search(pem)
    if found is None:
        raise ValueError("there is no certificate in it")
    return hashlib.sha256(base64.b64decode(found.group(1))).hexdigest()


def normal_fingerprint(pin: str) -> str:
    """Write a fingerprint as 64 lower-case digits; raises UsageError when it is none."""
    digits = pin.lower().removeprefix("sha256:").replace(":", "").strip()
    if not re.fullmatch(r"[0-9a-f]{64}", digits):
        raise UsageError(f"'{pin}' is no fingerprint", "paste the line that the server printed")
    return digits


def pinned_context(pem: bytes, pin: str) -> ssl.SSLContext:
    """Return a context that trusts one authority only, by its chain and the server's name.

    Raises PinError when the certificate is another than the pinned one.
    """
    if fingerprint(pem) != normal_fingerprint(pin):
        raise PinError(
            f"the server's authority is {fingerprint(pem)}, not {normal_fingerprint(pin)}",
            _ANOTHER_HINT,
        )
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.minimum_version = ssl.TLSVersion.TLSv1_2
    context.load_verify_locations(cadata=pem.decode("ascii"))
    context.verify_flags |= ssl.VerifyFlags(_NO_CHECK_TIME)
    return context


def fetch_ca(url: str) -> bytes:
    """Fetch a server's authority certificate (PEM); no secret is sent, nothing is trusted.

    Raises OSError when it does not answer, PinError when it has none.
    """
    parts = urlsplit(url)
    host, port = parts.hostname or "", parts.port or 443
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.check_hostname = False
    context.verify_mode = ssl.CERT_NONE  # the certificate is compared with the pin
    request = f"GET {CA_PATH} HTTP/1.0\r\nHost: {parts.netloc}\r\n\r\n".encode()
    answer = b""
    with (
        socket.create_connection((host, port), _TIMEOUT_S) as plain,
        context.wrap_socket(plain, server_hostname=host) as secure,
    ):
        secure.sendall(request)
        while len(answer) < _MOST_BYTES and (more := secure.recv(8192)):
            answer += more
    found = _PEM.search(answer)
    if found is None:
        raise PinError(
            f"{url} does not give its authority's certificate", "is this an Amberbox server?"
        )
    return found.group(0) + b"\n"


def is_loopback(host: str) -> bool:
    """Return whether a host is this computer's loopback, without asking a name server."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host.lower() == "localhost"
