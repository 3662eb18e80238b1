"""ROS names, URIs and hosts as people write them."""

from __future__ import annotations

import pytest

from amberbox.blackbox.sources.ros1.master import (
    global_name,
    host_and_port,
    is_global_name,
    mapped,
    master_uri,
    own_host,
)
from amberbox.core.tls import is_loopback


@pytest.mark.parametrize(
    ("text", "uri"),
    [
        ("localhost", "http://localhost:11311/"),
        ("robot:11312", "http://robot:11312/"),
        ("http://localhost:11311", "http://localhost:11311/"),
        ("http://10.0.0.7:11311/", "http://10.0.0.7:11311/"),
        (" http://robot ", "http://robot:11311/"),
        ("http://[fe80::1]:11311", "http://[fe80::1]:11311/"),
    ],
)
def test_master_uris_are_completed(text: str, uri: str) -> None:
    assert master_uri(text) == uri


@pytest.mark.parametrize(
    "text", ["https://robot:11311", "tcp://robot", "robot:port", "http://", "ro bot", "robot:99999"]
)
def test_what_cannot_be_a_master_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match=r"."):
        master_uri(text)


@pytest.mark.parametrize(
    ("name", "expected"),
    [("odom", "/odom"), ("/odom", "/odom"), ("/a//b/", "/a/b"), ("a/b", "/a/b")],
)
def test_names_become_global(name: str, expected: str) -> None:
    assert global_name(name) == expected
    assert is_global_name(expected)


@pytest.mark.parametrize("name", ["/", "/1a", "/a b", "/a-b", "~x", "/~x"])
def test_names_that_ros_does_not_allow(name: str) -> None:
    assert not is_global_name(name)


def test_hosts_are_mapped_without_regard_to_case() -> None:
    hosts = {"Robot-7": "10.0.0.7"}
    assert mapped("http://robot-7:4711/", hosts) == "http://10.0.0.7:4711/"
    assert mapped("http://other:4711", hosts) == "http://other:4711/"


def test_a_uri_without_port_is_no_node() -> None:
    with pytest.raises(ValueError, match="not the address"):
        host_and_port("http://robot/")


@pytest.mark.parametrize(
    ("host", "expected"),
    [("localhost", True), ("127.0.1.1", True), ("::1", True), ("10.0.0.1", False), ("pi", False)],
)
def test_loopback_is_known_by_name(host: str, expected: bool) -> None:
    assert is_loopback(host) is expected


def test_the_own_host_follows_ros_order() -> None:
    environment = {"ROS_HOSTNAME": "box.local", "ROS_IP": "10.0.0.2"}
    master = "http://localhost:11311/"
    assert own_host("10.9.9.9", environment, master) == "10.9.9.9"
    assert own_host("", environment, master) == "box.local"
    assert own_host("", {"ROS_IP": "10.0.0.2"}, master) == "10.0.0.2"
    assert own_host("", {}, master) == "127.0.0.1"
