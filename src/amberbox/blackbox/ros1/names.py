"""ROS 1 names and addresses: topics, URIs of nodes, where the box itself can be reached."""

from __future__ import annotations

import ipaddress
import re
import socket
from collections.abc import Mapping
from urllib.parse import urlsplit

DEFAULT_PORT = 11311
DEFAULT_MASTER = f"http://localhost:{DEFAULT_PORT}/"

_NAME = re.compile(r"(/[A-Za-z][A-Za-z0-9_]*)(/[A-Za-z0-9_]+)*")
_HOST = re.compile(r"[A-Za-z0-9_.-]+|\[[0-9A-Fa-f:.]+\]")


def global_name(name: str) -> str:
    """Return a topic or node name with its leading slash: ``odom`` becomes ``/odom``."""
    return "/" + "/".join(part for part in name.split("/") if part)


def is_global_name(name: str) -> bool:
    """Tell whether ROS allows a name."""
    return _NAME.fullmatch(name) is not None


def master_uri(text: str) -> str:
    """Complete the URI of a master: ``localhost`` and ``robot:11312`` are understood.

    Raises ValueError, with what is wrong, if it cannot be one.
    """
    whole = text.strip() if "://" in text else f"http://{text.strip()}"
    parts = urlsplit(whole)
    if parts.scheme != "http":
        raise ValueError(f"'{parts.scheme}' is not a protocol ROS masters speak")
    host, port = host_and_port(whole, DEFAULT_PORT)
    if not _HOST.fullmatch(f"[{host}]" if ":" in host else host):
        raise ValueError(f"'{text}' names no host")
    return _uri(host, port)


def host_and_port(uri: str, default_port: int = 0) -> tuple[str, int]:
    """Split the URI of a master or node; raise ValueError if it holds no host or port."""
    parts = urlsplit(uri)
    port = parts.port or default_port
    if not parts.hostname or not port:
        raise ValueError(f"'{uri}' is not the address of a ROS node")
    return parts.hostname, port


def mapped(uri: str, hosts: Mapping[str, str]) -> str:
    """Replace the host of a URI by the address configured for it."""
    host, port = host_and_port(uri)
    return _uri(mapped_host(host, hosts), port)


def mapped_host(host: str, hosts: Mapping[str, str]) -> str:
    """Return the address configured for a host name; names compare without case."""
    lower = {name.lower(): address for name, address in hosts.items()}
    return lower.get(host.lower(), host)


def _uri(host: str, port: int) -> str:
    return f"http://[{host}]:{port}/" if ":" in host else f"http://{host}:{port}/"


def is_loopback(host: str) -> bool:
    """Tell whether a host is this computer's loopback, without asking a name server."""
    if host.lower() == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def own_host(configured: str, environment: Mapping[str, str], master: str) -> str:
    """Choose the host under which the master can call the box.

    The configured one, else ROS_HOSTNAME, else ROS_IP (ROS's own order), else the address of
    the interface that leads to the master.
    """
    named = configured or environment.get("ROS_HOSTNAME") or environment.get("ROS_IP")
    return named or _address_towards(*host_and_port(master))


def _address_towards(host: str, port: int) -> str:
    if is_loopback(host):
        return "127.0.0.1"
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect((host, port))  # UDP: sends nothing, only picks the route
        except OSError:
            return socket.gethostname()
        address: str = probe.getsockname()[0]
        return address
