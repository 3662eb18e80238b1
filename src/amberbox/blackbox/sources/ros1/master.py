"""The XML-RPC API of a ROS 1 master and of nodes: names, addresses, settings, errors and calls.

Answers are parsed with ElementTree's C parser: the box asks the master for the system state every
second; on a large robot that is 100 kB, and reading it with the standard library takes more than
twice the time.
"""

from __future__ import annotations

import http.client
import re
import socket
import time
import xmlrpc.client
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from http import HTTPStatus
from typing import Any
from urllib.parse import urlsplit
from xml.etree import ElementTree
from xml.etree.ElementTree import ParseError

from amberbox.core.errors import AmberboxError, UsageError
from amberbox.core.tls import is_loopback


@dataclass(frozen=True)
class NodeSettings:
    """Settings of any node; ``timeout_s`` is that of one call or handshake."""

    master_uri: str = "http://localhost:11311/"
    caller_id: str = "/amberbox"
    hosts: Mapping[str, str] = field(default_factory=dict)
    advertise: str = ""
    tcp_nodelay: bool = True
    message_limit: int = 64_000_000
    dead_after_s: float = 40.0
    timeout_s: float = 3.0
    first_retry_s: float = 0.1


@dataclass(frozen=True)
class SubscriberSettings(NodeSettings):
    """Settings of the subscriber; the defaults of its times are changed by tests only."""

    invisible: bool = False
    poll_s: float = 1.0
    unknown_after_s: float = 10.0
    listed_retry_s: float = 2.0
    unlisted_retry_s: float = 30.0


class RosError(AmberboxError):
    """A peer on the ROS network failed."""


class RosNoAnswerError(RosError):
    """No answer from an address, or one that is not ROS."""


class RosRefusedError(RosError):
    """A master or node refused a call."""


class TcprosError(RosError):
    """A peer sent data that are not valid TCPROS."""


DEFAULT_PORT = 11311
DEFAULT_MASTER = f"http://localhost:{DEFAULT_PORT}/"

_NAME = re.compile(r"(/[A-Za-z][A-Za-z0-9_]*)(/[A-Za-z0-9_]+)*")
_HOST = re.compile(r"[A-Za-z0-9_.-]+|\[[0-9A-Fa-f:.]+\]")


def global_name(name: str) -> str:
    """Return a topic or node name with its leading slash: ``odom`` becomes ``/odom``."""
    return "/" + "/".join(part for part in name.split("/") if part)


def is_global_name(name: str) -> bool:
    """Return whether ROS allows a name."""
    return _NAME.fullmatch(name) is not None


def master_uri(text: str) -> str:
    """Return the full URI of a master; ``localhost`` and ``robot:11312`` are accepted.

    Raises ValueError with the problem if it cannot be one.
    """
    whole = text.strip() if "://" in text else f"http://{text.strip()}"
    parts = urlsplit(whole)
    if parts.scheme != "http":
        raise ValueError(f"'{parts.scheme}' is not a protocol ROS masters speak")
    host, port = host_and_port(whole, DEFAULT_PORT)
    if not _HOST.fullmatch(f"[{host}]" if ":" in host else host):
        raise ValueError(f"'{text}' names no host")
    return _uri(host, port)


def chosen_master(configured: str, environment: Mapping[str, str]) -> str:
    """Return the URI of the master: the configured one, ROS_MASTER_URI, or the local one.

    Raises UsageError if it cannot be one.
    """
    try:
        return master_uri(configured or environment.get("ROS_MASTER_URI") or DEFAULT_MASTER)
    except ValueError as error:
        raise UsageError(f"ros_master_uri: {error}", "write http://HOST:11311") from error


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


def own_host(configured: str, environment: Mapping[str, str], master: str) -> str:
    """Return the host under which the master can call the box.

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


Element = ElementTree.Element

MOST_BYTES = 2 << 20  # largest answer; the system state of a large robot has 100 kB
DEEPEST = 32  # deepest nesting of values; those of ROS have four levels


class AnswerParser:
    """The parser that ``xmlrpc.client.Transport`` feeds an answer to."""

    def __init__(self) -> None:
        self._parser = ElementTree.XMLParser()
        self._size = 0
        self.root: Element | None = None

    def feed(self, data: bytes) -> None:
        """Parse a piece of the answer; raise ValueError when the answer is too long."""
        self._size += len(data)
        if self._size > MOST_BYTES:
            raise ValueError(f"an answer of more than {MOST_BYTES} bytes")
        self._parser.feed(data)

    def close(self) -> None:
        """Finish parsing; raise ElementTree.ParseError if the answer is not XML."""
        self.root = self._parser.close()


class AnswerReader:
    """The unmarshaller from which ``xmlrpc.client.Transport`` gets the values of an answer."""

    def __init__(self, parser: AnswerParser) -> None:
        self._parser = parser

    def close(self) -> tuple[Any, ...]:
        """Return the values; raise Fault, or ValueError if it is no answer."""
        root = self._parser.root
        if root is None or root.tag != "methodResponse" or len(root) != 1:
            raise ValueError("no method response")
        if root[0].tag == "fault":
            fault = _value(_only(root[0]))
            raise xmlrpc.client.Fault(fault["faultCode"], fault["faultString"])
        return tuple(_value(_only(param)) for param in root[0])


def _only(element: Element) -> Element:
    if len(element) != 1:
        raise ValueError(f"<{element.tag}> holds {len(element)} elements")
    return element[0]


def _value(element: Element, depth: int = 0) -> Any:
    if not len(element):
        return element.text or ""
    typed = _only(element)
    if depth > DEEPEST:
        raise ValueError(f"values nested deeper than {DEEPEST}")
    if typed.tag == "array":
        return [_value(value, depth + 1) for value in _only(typed)]
    if typed.tag == "struct":
        return {_text(m.find("name")): _value(m[-1], depth + 1) for m in typed}
    if typed.tag not in _READERS:
        raise ValueError(f"<{typed.tag}> is no value of ROS")
    return _READERS[typed.tag](typed)


def _number(element: Element) -> int:
    return int(element.text or "")


def _text(element: Element | None) -> str:
    return "" if element is None else element.text or ""


_READERS: dict[str, Callable[[Element], Any]] = {
    "string": _text,
    "int": _number,
    "i4": _number,
    "i8": _number,
    "boolean": lambda element: bool(_number(element)),
    "double": lambda element: float(element.text or ""),
    "nil": lambda element: None,
    "base64": _text,
    "dateTime.iso8601": _text,
}


_PIECE = 1 << 16
_SLOWEST = 5  # time for a whole answer, in multiples of the time limit


class _TimedTransport(xmlrpc.client.Transport):
    """A transport with a time limit that keeps its connection between calls."""

    accept_gzip_encoding = False  # compressed data could unpack to any size

    def __init__(self, timeout_s: float) -> None:
        super().__init__()
        self._timeout_s = timeout_s

    def make_connection(self, host: Any) -> http.client.HTTPConnection:
        if self._connection and host == self._connection[0] and self._connection[1]:
            return self._connection[1]
        connection = http.client.HTTPConnection(str(host), timeout=self._timeout_s)
        self._connection = host, connection
        return connection

    def single_request(
        self, host: Any, handler: str, request_body: Any, verbose: bool = False
    ) -> Any:
        """Send a request and read the answer up to limits of size and time.

        The base class reads and unpacks an answer of any size.
        """
        try:
            response = self.send_request(host, handler, request_body, verbose).getresponse()
            if response.status != HTTPStatus.OK:
                raise xmlrpc.client.ProtocolError(
                    str(host), response.status, response.reason, dict(response.getheaders())
                )
            return self._answer(response)
        except xmlrpc.client.Fault:
            raise
        except Exception:
            self.close()
            raise

    def _answer(self, response: http.client.HTTPResponse) -> Any:
        parser, reader = self.getparser()
        end_s = time.monotonic() + _SLOWEST * self._timeout_s
        while piece := response.read1(_PIECE):
            parser.feed(piece)
            if time.monotonic() > end_s:
                raise TimeoutError("the answer does not end")
        response.close()  # the connection stays: it is ready for the next call
        parser.close()
        return reader.close()

    def getparser(self) -> Any:
        parser = AnswerParser()
        return parser, AnswerReader(parser)


class RosApi:
    """One master or node that answers ``(code, text, value)``; for one thread."""

    def __init__(self, uri: str, settings: NodeSettings) -> None:
        self.uri = uri
        self._caller_id = settings.caller_id
        address = mapped(uri, settings.hosts)
        transport = _TimedTransport(settings.timeout_s)
        self._proxy = xmlrpc.client.ServerProxy(address, transport, allow_none=True)

    def call(self, method: str, *arguments: Any) -> Any:
        """Call a method; raise NoAnswerError or RefusedError."""
        try:
            answer = getattr(self._proxy, method)(self._caller_id, *arguments)
            code, text, value = answer
        except OSError as error:
            raise RosNoAnswerError(f"{self.uri}: {error.strerror or error}") from error
        except (http.client.HTTPException, xmlrpc.client.Error, ParseError) as error:
            raise RosNoAnswerError(f"{self.uri} does not speak ROS: {error}") from error
        except (LookupError, TypeError, ValueError) as error:
            raise RosNoAnswerError(f"{self.uri} gave no ROS answer to {method}: {error}") from error
        if code != 1:
            raise RosRefusedError(f"{self.uri} refused {method}: {text}")
        return value

    def close(self) -> None:
        """End the connection that is kept between calls."""
        self._proxy("close")()


@dataclass(frozen=True)
class SystemState:
    """The nodes behind all topics and services, as known to the master."""

    publishers: Mapping[str, Sequence[str]]
    subscribers: Mapping[str, Sequence[str]]
    services: Mapping[str, Sequence[str]] = field(default_factory=dict)


class RosMaster:
    """The calls to the ROS master that nodes need."""

    def __init__(self, settings: NodeSettings) -> None:
        self._api = RosApi(settings.master_uri, settings)

    def graph(self) -> SystemState:
        """Return the publishers and subscribers of all topics, and who offers services."""
        try:
            return SystemState(*map(_nodes_by_name, self._api.call("getSystemState")))
        except (TypeError, ValueError) as error:
            raise RosNoAnswerError(f"{self._api.uri} gave no system state: {error}") from error

    def topic_types(self) -> dict[str, str]:
        """Return the types of the topics as far as they are known."""
        try:
            pairs = self._api.call("getTopicTypes")
            return {str(topic): str(kind) for topic, kind in pairs if kind != "*"}
        except (TypeError, ValueError) as error:
            raise RosNoAnswerError(f"{self._api.uri} gave no topic types: {error}") from error

    def parameters(self) -> dict[str, Any]:
        """Return all parameters as a tree."""
        tree = self._api.call("getParam", "/")
        if not isinstance(tree, dict):
            raise RosNoAnswerError(f"{self._api.uri} gave no parameters")
        return tree

    def node_uri(self, node: str) -> str:
        """Return the URI of a node; RefusedError if the master does not know it."""
        return str(self._api.call("lookupNode", node))

    def subscribe(self, topic: str, own_uri: str) -> list[str]:
        """Register as a subscriber; return the URIs of the publishers."""
        return [str(uri) for uri in self._api.call("registerSubscriber", topic, "*", own_uri)]

    def unsubscribe(self, topic: str, own_uri: str) -> None:
        """Unregister as a subscriber."""
        self._api.call("unregisterSubscriber", topic, own_uri)

    def publish(self, topic: str, type_name: str, own_uri: str) -> list[str]:
        """Register as a publisher; return the URIs of the subscribers."""
        return [str(u) for u in self._api.call("registerPublisher", topic, type_name, own_uri)]

    def unpublish(self, topic: str, own_uri: str) -> None:
        """Unregister as a publisher."""
        self._api.call("unregisterPublisher", topic, own_uri)

    def service_uri(self, service: str) -> str:
        """Return the ``rosrpc`` URI of a service; RefusedError if the master does not know it."""
        return str(self._api.call("lookupService", service))

    def close(self) -> None:
        """End the connection."""
        self._api.close()


def _nodes_by_name(pairs: Any) -> dict[str, list[str]]:
    return {str(name): [str(node) for node in nodes] for name, nodes in pairs}


def request_topic(node_uri: str, topic: str, settings: NodeSettings) -> tuple[str, int]:
    """Request a topic from a publisher; return the host and TCP port to connect to."""
    try:
        api = RosApi(node_uri, settings)
    except ValueError as error:
        raise RosNoAnswerError(str(error)) from error
    try:
        answer = api.call("requestTopic", topic, [["TCPROS"]])
        _, host, port = answer
        return mapped_host(str(host), settings.hosts), int(port)
    except (TypeError, ValueError) as error:
        raise RosRefusedError(f"{node_uri} offers no TCPROS connection for {topic}") from error
    finally:
        api.close()


def publications(node_uri: str, settings: NodeSettings) -> dict[str, str]:
    """Return the topics that a node publishes, with their types."""
    api = RosApi(node_uri, settings)
    try:
        return {str(topic): str(kind) for topic, kind in api.call("getPublications")}
    except (TypeError, ValueError) as error:
        raise RosNoAnswerError(f"{node_uri} gave no publications: {error}") from error
    finally:
        api.close()


def host_of(uri: str) -> str:
    """Return the host of a URI for messages, or the URI itself."""
    try:
        return host_and_port(uri)[0]
    except ValueError:
        return uri
