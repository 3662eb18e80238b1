"""A dishonest robot over the real socket: a false id, old frames, invalid frames."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import msgspec
import pytest
from sqlalchemy import select
from starlette.testclient import TestClient, WebSocketDenialResponse
from starlette.websockets import WebSocketDisconnect

from amberbox.blackbox.journal import channels
from amberbox.link import limits
from amberbox.link.frames import (
    BeatFrame,
    Bye,
    Hello,
    JournalPosition,
    LinkRow,
    Pong,
    RowsFrame,
    RunEnd,
    ServerFrame,
    Welcome,
    WriterReach,
    encode,
    from_server,
)
from amberbox.server.http.auth import COOKIE
from amberbox.server.schema import ROW
from tests.server.house import URL, House

LINK = limits.PATH
STORE = "12345678-1234-1234-1234-123456789012"
REACH = WriterReach(
    JournalPosition(1, 0),
    JournalPosition(1, 9),
    JournalPosition(1, 9),
    (RunEnd(1, "b", 9, closed=False),),
)


def _hello(robot: str) -> Hello:
    return Hello(robot, STORE, "boot", {"watch": REACH}, "", 0, 0, "1")


def _row(seq: int) -> LinkRow:
    status = {"component": "laser", "mode": "", "level": "ok", "seq": seq}
    return LinkRow("watch", 1, seq, channels.STATUS, 0, msgspec.json.encode(status))


@contextmanager
def _connected(client: TestClient, hello: Hello) -> Iterator[Any]:
    with client.websocket_connect(LINK) as socket:
        socket.send_bytes(encode(hello))
        yield socket


def _hear(socket: Any) -> ServerFrame:
    return from_server(socket.receive_bytes())


def _rows(home: House) -> list[tuple[str, int]]:
    with home.services.database.reading() as connection:
        return [tuple(row) for row in connection.execute(select(ROW.c.robot, ROW.c.seq))]


def _ends(socket: Any) -> None:
    """Read until the server closes; the last word may be why."""
    try:
        frame = _hear(socket)
        assert isinstance(frame, Bye), frame
        socket.receive_bytes()
    except WebSocketDisconnect:
        return
    raise AssertionError("it goes on")


def test_a_robot_cannot_say_that_it_is_another(home: House) -> None:
    with _connected(home.robot_client("ropod_001"), _hello("ropod_002")) as socket:
        _ends(socket)
    assert "ropod_002" not in home.services.links.robots
    assert _rows(home) == []


def test_a_key_opens_nothing_for_another_name(home: House) -> None:
    client = home.client()
    client.headers["Authorization"] = f"Robot ropod_002:{home.keys['ropod_001']}"
    with pytest.raises(WebSocketDenialResponse) as refused, client.websocket_connect(LINK):
        pass
    assert refused.value.status_code == 401


def test_a_robot_uploads_and_hands_in_as_itself_whatever_it_sends(home: House) -> None:
    """No route of robots takes the name of a robot: there is nothing to lie with."""
    from amberbox.server.app import rules

    paths = [path for _, path in rules() if path.startswith(LINK)]
    assert paths
    assert not [path for path in paths if "{robot" in path]


def test_a_page_cannot_be_a_robot(home: House) -> None:
    for headers in ({"Origin": URL}, {"Cookie": f"{COOKIE}=x"}):
        client = home.robot_client()
        client.headers.update(headers)
        with pytest.raises(WebSocketDenialResponse) as refused, client.websocket_connect(LINK):
            pass
        assert refused.value.status_code == 403


def test_frames_of_an_older_connection_are_refused(home: House) -> None:
    with home.robot_client() as client, _connected(client, _hello("ropod_001")) as socket:
        old = _hear(socket)
        with _connected(client, _hello("ropod_001")) as again:
            new = _hear(again)
            assert isinstance(old, Welcome) and isinstance(new, Welcome)
            assert new.epoch > old.epoch
            again.send_bytes(encode(RowsFrame(old.epoch, 1, [_row(1)], {})))
            _ends(again)
    assert _rows(home) == []


def test_frames_from_the_future_are_refused(home: House) -> None:
    with _connected(home.robot_client(), _hello("ropod_001")) as socket:
        welcome = _hear(socket)
        assert isinstance(welcome, Welcome)
        socket.send_bytes(encode(RowsFrame(welcome.epoch + 1, 1, [_row(1)], {})))
        _ends(socket)
    assert _rows(home) == []


def test_what_is_sent_again_is_kept_once(home: House) -> None:
    with home.robot_client() as client, _connected(client, _hello("ropod_001")) as first:
        _send_thrice(first)
        with _connected(client, _hello("ropod_001")) as second:
            _send_thrice(second)
    assert sorted(_rows(home)) == [("ropod_001", 1), ("ropod_001", 2)]


def _send_thrice(socket: Any) -> None:
    welcome = _hear(socket)
    assert isinstance(welcome, Welcome)
    for number in range(3):
        socket.send_bytes(encode(RowsFrame(welcome.epoch, number, [_row(1), _row(2)], {})))
    socket.send_bytes(encode(BeatFrame(welcome.epoch, 0, 0, 0)))
    while not isinstance(_hear(socket), Pong):
        pass


def test_a_recording_of_somebody_elses_hello_is_no_entrance(home: House) -> None:
    with _connected(home.robot_client("ropod_001"), _hello("ropod_001")) as socket:
        assert isinstance(_hear(socket), Welcome)
    with _connected(home.robot_client("ropod_003"), _hello("ropod_001")) as socket:
        _ends(socket)


@pytest.mark.parametrize(
    "frame",
    [
        b"",
        b"\0",
        b"\xff" * 100,
        encode(_hello("ropod_001"))[:-1],
        b"\0\0\0\0" + encode(_hello("ropod_001"))[4:],
        bytes(2 << 20),
    ],
    ids=["nothing", "a byte", "noise", "cut", "damaged", "too large"],
)
def test_what_is_no_frame_ends_the_connection(home: House, frame: bytes) -> None:
    with home.robot_client().websocket_connect(LINK) as socket:
        socket.send_bytes(frame)
        _ends(socket)
    assert _rows(home) == []


def test_a_disabled_robot_and_a_revoked_key_do_not_connect(home: House) -> None:
    client, admin = home.robot_client(), home.client("admin")
    admin.patch("/api/v1/robots/ropod_001", json={"disabled": True})
    with pytest.raises(WebSocketDenialResponse), client.websocket_connect(LINK):
        pass
    admin.patch("/api/v1/robots/ropod_001", json={"disabled": False})
    admin.delete("/api/v1/robots/ropod_001/keys")
    with pytest.raises(WebSocketDenialResponse), client.websocket_connect(LINK):
        pass
