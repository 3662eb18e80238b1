"""Connections to MQTT brokers: addresses, credentials, and a client of paho for them."""

from __future__ import annotations

import ssl
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from amberbox.core.errors import AmberboxError

PORT, TLS_PORT = 1883, 8883
CONNECT_S = 3.0
_SCHEMES = {"mqtt": PORT, "mqtts": TLS_PORT}
_LONGEST = 65_535  # bytes of a topic


@dataclass(frozen=True, slots=True)
class BrokerAddress:
    """Where a broker is; written ``HOST``, ``HOST:PORT``, ``mqtt://HOST``, ``mqtts://HOST``."""

    host: str
    port: int
    tls: bool = False

    def __str__(self) -> str:
        return f"[{self.host}]:{self.port}" if ":" in self.host else f"{self.host}:{self.port}"


def broker_address(text: str) -> BrokerAddress:
    """Read an address; raises ValueError."""
    parts = urlsplit(text if "://" in text else f"mqtt://{text}")
    wrong = ValueError(f"'{text}' is no address; write HOST, HOST:PORT or mqtts://HOST:PORT")
    if parts.scheme not in _SCHEMES or not parts.hostname or parts.path not in ("", "/"):
        raise wrong
    if "@" in parts.netloc:
        raise ValueError("user and password have keys of their own: username, password")
    try:
        port = parts.port
    except ValueError:
        raise wrong from None
    if port == 0:
        raise wrong
    return BrokerAddress(parts.hostname, port or _SCHEMES[parts.scheme], parts.scheme == "mqtts")


@dataclass(frozen=True, slots=True)
class BrokerLogin:
    """Who the client is, and the files of TLS; a broker without users needs none of it."""

    client_id: str
    username: str = ""
    password: str = ""
    ca_file: str = ""
    cert_file: str = ""
    key_file: str = ""


def login_problems(
    address: str, login: BrokerLogin, keys: tuple[str, ...]
) -> Iterator[tuple[str, str]]:
    """Yield key and sentence for what is wrong; ``keys`` names the address, then the files."""
    try:
        broker = broker_address(address)
    except ValueError as error:
        yield keys[0], str(error)
        return
    files = (login.ca_file, login.cert_file, login.key_file)
    for key, file in zip(keys[1:], files, strict=True):
        if file and not broker.tls:
            yield key, f"needs TLS: write mqtts://{broker.host}"
    if bool(login.cert_file) != bool(login.key_file):
        yield keys[2 if login.cert_file else 3], "the certificate and its key go together"


def new_client(address: BrokerAddress, login: BrokerLogin, *, is_v5: bool) -> Any:
    """Return a client that is not connected yet; raises AmberboxError.

    It does not connect again by itself.
    """
    try:
        from paho.mqtt.client import Client
        from paho.mqtt.enums import CallbackAPIVersion, MQTTProtocolVersion
    except ImportError as error:
        raise AmberboxError("paho-mqtt is missing", "pip install 'amberbox[mqtt]'") from error
    client = Client(
        CallbackAPIVersion.VERSION2,
        client_id=login.client_id,
        protocol=MQTTProtocolVersion.MQTTv5 if is_v5 else MQTTProtocolVersion.MQTTv311,
        clean_session=None if is_v5 else True,
        reconnect_on_failure=False,
    )
    client.connect_timeout = CONNECT_S
    if login.username or login.password:
        client.username_pw_set(login.username, login.password or None)
    if address.tls:
        client.tls_set_context(_tls_context(login))
    return client


def _tls_context(login: BrokerLogin) -> ssl.SSLContext:
    missing = [name for name in (login.ca_file, login.cert_file, login.key_file)
               if name and not Path(name).is_file()]  # fmt: skip
    if missing:
        raise AmberboxError(
            f"there is no file {missing[0]}", "copy it to where the folder names it"
        )
    try:
        context = ssl.create_default_context(cafile=login.ca_file or None)
        if login.cert_file:
            context.load_cert_chain(login.cert_file, login.key_file)
    except (OSError, ssl.SSLError) as error:
        what = f"the files of TLS cannot be used: {error.strerror or error}"
        raise AmberboxError(what, "they must be PEM files that belong together") from error
    return context


def filter_problem(text: str) -> str:
    """Return what is wrong with a topic filter, ``+`` and ``#`` included; empty if nothing is."""
    if not 0 < len(text.encode(errors="replace")) <= _LONGEST or "\0" in text:
        return f"'{text[:40]}' is no topic of MQTT"
    if "*" in text:
        return f"'{text}': in MQTT, + stands for one level and # for all below"
    levels = text.split("/")
    if any(("+" in level or "#" in level) and len(level) > 1 for level in levels):
        return f"'{text}': + and # stand for whole levels"
    if "#" in levels[:-1]:
        return f"'{text}': # may only be the last level"
    return ""


def overlap(one: str, other: str) -> bool:
    """Return whether some topic fits both filters."""
    first, second = one.split("/"), other.split("/")
    for mine, its in zip(first, second, strict=False):
        if "#" in (mine, its):
            return True
        if mine != its and "+" not in (mine, its):
            return False
    return len(first) == len(second)
