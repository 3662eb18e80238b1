"""The box as a ROS node answers shortly, and nothing that strangers send does harm."""

from __future__ import annotations

import os
import socket
import xmlrpc.client
from collections.abc import Iterator, Sequence
from typing import Any

import pytest

from amberbox.blackbox.sources.ros1.node_server import MOST_BYTES, NodeServer
from amberbox.testing.clock import PATIENCE_S

Updates = list[tuple[str, Sequence[str]]]


@pytest.fixture
def updates() -> Updates:
    return []


@pytest.fixture
def node(updates: Updates) -> Iterator[NodeServer]:
    node = NodeServer("127.0.0.1", 0, "http://m:1/", lambda t, u: updates.append((t, u)), print)
    node.start()
    yield node
    node.close()


def call(node: NodeServer, method: str, *arguments: Any) -> Any:
    proxy = xmlrpc.client.ServerProxy(f"http://127.0.0.1:{node.port}/")
    return getattr(proxy, method)("/test", *arguments)


def test_an_update_is_put_down(node: NodeServer, updates: Updates) -> None:
    assert call(node, "publisherUpdate", "/a", ["http://h:1/"])[0] == 1
    assert updates == [("/a", ["http://h:1/"])]


def test_tools_get_answers(node: NodeServer) -> None:
    assert call(node, "getPid")[2] == os.getpid()
    assert call(node, "getMasterUri")[2] == "http://m:1/"
    assert call(node, "getBusInfo") == [1, "", []]
    assert call(node, "requestTopic", "/a", [["TCPROS"]])[0] == 0
    for method in ("getPublications", "getSubscriptions", "getBusStats"):
        assert call(node, method)[0] == 1
    assert call(node, "paramUpdate", "/key", 1)[0] == 1


def test_an_unknown_or_wrong_call_is_a_fault(node: NodeServer) -> None:
    with pytest.raises(xmlrpc.client.Fault):
        call(node, "format_disk")
    with pytest.raises(xmlrpc.client.Fault):
        call(node, "publisherUpdate", "too few")
    assert call(node, "getPid")[0] == 1


@pytest.mark.parametrize("length", [str(MOST_BYTES + 1), "-5", "many"])
def test_a_request_without_end_is_refused(node: NodeServer, length: str) -> None:
    with socket.create_connection(("127.0.0.1", node.port), PATIENCE_S) as sock:
        sock.sendall(f"POST / HTTP/1.0\r\nContent-Length: {length}\r\n\r\n".encode())
        assert b"413" in sock.recv(100)


def test_the_last_port_is_used_again_if_it_is_free(node: NodeServer) -> None:
    busy = NodeServer("127.0.0.1", node.port, "", lambda t, u: None, print)
    busy.start()
    assert busy.port != node.port
    busy.close()
    again = NodeServer("127.0.0.1", busy.port, "", lambda t, u: None, print)
    again.start()
    assert again.port == busy.port
    again.close()
