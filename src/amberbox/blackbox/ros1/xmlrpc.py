"""Calls to a ROS 1 master or node: XML-RPC with a time limit, answers checked."""

from __future__ import annotations

import http.client
import time
import xmlrpc.client
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from http import HTTPStatus
from typing import Any
from xml.etree.ElementTree import ParseError

from amberbox.blackbox.ros1.names import host_and_port, mapped, mapped_host
from amberbox.blackbox.ros1.settings import NoAnswerError, RefusedError, Settings
from amberbox.blackbox.ros1.xmlvalues import AnswerParser, AnswerReader

_PIECE = 1 << 16
_SLOWEST = 5
"""Waits an answer may take in all, each up to the time limit."""


class _TimedTransport(xmlrpc.client.Transport):
    """Gives up after a while; keeps its connection between calls."""

    accept_gzip_encoding = False  # what is packed could unpack to anything

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
        """Send a request and read the answer as it comes, up to a size and for a time.

        The base class reads and unpacks whatever a peer sends.
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


class Api:
    """One master or node that answers ``(code, text, value)``; for one thread."""

    def __init__(self, uri: str, settings: Settings) -> None:
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
            raise NoAnswerError(f"{self.uri}: {error.strerror or error}") from error
        except (http.client.HTTPException, xmlrpc.client.Error, ParseError) as error:
            raise NoAnswerError(f"{self.uri} does not speak ROS: {error}") from error
        except (LookupError, TypeError, ValueError) as error:
            raise NoAnswerError(f"{self.uri} gave no ROS answer to {method}: {error}") from error
        if code != 1:
            raise RefusedError(f"{self.uri} refused {method}: {text}")
        return value

    def close(self) -> None:
        """End the connection that is kept between calls."""
        self._proxy("close")()


@dataclass(frozen=True)
class Graph:
    """Who publishes and who subscribes what, as the master knows it."""

    publishers: Mapping[str, Sequence[str]]
    subscribers: Mapping[str, Sequence[str]]


class Master:
    """The calls to the ROS master that a listener needs."""

    def __init__(self, settings: Settings) -> None:
        self._api = Api(settings.master_uri, settings)

    def graph(self) -> Graph:
        """Ask who publishes and subscribes what."""
        try:
            publishers, subscribers, _ = self._api.call("getSystemState")
            return Graph(_nodes_by_topic(publishers), _nodes_by_topic(subscribers))
        except (TypeError, ValueError) as error:
            raise NoAnswerError(f"{self._api.uri} gave no system state: {error}") from error

    def node_uri(self, node: str) -> str:
        """Ask where a node can be called; RefusedError if the master does not know it."""
        return str(self._api.call("lookupNode", node))

    def subscribe(self, topic: str, own_uri: str) -> list[str]:
        """Register as a subscriber; return the URIs of the publishers."""
        return [str(uri) for uri in self._api.call("registerSubscriber", topic, "*", own_uri)]

    def unsubscribe(self, topic: str, own_uri: str) -> None:
        """Take the registration back."""
        self._api.call("unregisterSubscriber", topic, own_uri)

    def close(self) -> None:
        """End the connection."""
        self._api.close()


def _nodes_by_topic(pairs: Any) -> dict[str, list[str]]:
    return {str(topic): [str(node) for node in nodes] for topic, nodes in pairs}


def request_topic(node_uri: str, topic: str, settings: Settings) -> tuple[str, int]:
    """Ask a publisher where to connect for a topic; return host and TCP port."""
    try:
        api = Api(node_uri, settings)
    except ValueError as error:
        raise NoAnswerError(str(error)) from error
    try:
        answer = api.call("requestTopic", topic, [["TCPROS"]])
        _, host, port = answer
        return mapped_host(str(host), settings.hosts), int(port)
    except (TypeError, ValueError) as error:
        raise RefusedError(f"{node_uri} offers no TCPROS connection for {topic}") from error
    finally:
        api.close()


def publications(node_uri: str, settings: Settings) -> list[str]:
    """Ask a node for the topics it publishes."""
    api = Api(node_uri, settings)
    try:
        return [str(topic) for topic, _ in api.call("getPublications")]
    except (TypeError, ValueError) as error:
        raise NoAnswerError(f"{node_uri} gave no publications: {error}") from error
    finally:
        api.close()


def host_of(uri: str) -> str:
    """Return the host of a URI for messages, or the URI itself."""
    try:
        return host_and_port(uri)[0]
    except ValueError:
        return uri
