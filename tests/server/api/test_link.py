"""The robots' routes of the API: who is admitted, and the state of uploads."""

from __future__ import annotations

import asyncio
import hashlib
import uuid
import zlib
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import msgspec
import pytest
from starlette.testclient import TestClient, WebSocketDenialResponse
from starlette.websockets import WebSocketDisconnect

from amberbox.link import uploads
from amberbox.link.frames import Bye, Hello, ServerFrame, Welcome, encode, from_server
from amberbox.link.limits import PIECE_BYTES
from amberbox.link.uploads import Proof
from amberbox.server.accounts.robots import disable_robot, revoke_keys, rotate_key
from amberbox.server.archive.maintenance import ServerDisk
from amberbox.server.bus import ServerChange
from amberbox.server.http.auth import COOKIE
from amberbox.server.ingest.link_server import SocketClosedError
from amberbox.server.workers.pool import EACH
from amberbox.testing.clock import PATIENCE_S
from tests.server.house import House, house

STORE = str(uuid.UUID(int=7, version=4))
JOURNAL = f"/link/v1/journals/{STORE}/journal/000001-aaaa-0001.mcap"
CONTENT = b"no journal" * 100


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Iterator[House]:
    with house(tmp_path_factory.mktemp("link") / "server") as found:
        yield found


def about(content: bytes = CONTENT, **more: str) -> dict[str, str]:
    digest = hashlib.sha256(content).hexdigest()
    return {uploads.BYTES: str(len(content)), uploads.SHA256: digest, **more}


def piece(content: bytes, offset: int = 0) -> dict[str, str]:
    return about(content, **{uploads.OFFSET: str(offset), uploads.CRC: str(zlib.crc32(content))})


def denied(client: TestClient, headers: dict[str, str] | None = None) -> int:
    """Try to open the link's socket; return the status that is answered."""
    with (
        pytest.raises((WebSocketDenialResponse, WebSocketDisconnect)) as found,
        client.websocket_connect("/link/v1", headers=headers or {}),
    ):
        pass
    assert isinstance(found.value, WebSocketDenialResponse)
    return int(found.value.status_code)


def test_robots_come_with_a_key_and_nothing_that_browsers_send(home: House) -> None:
    robot = home.robot_client()
    assert denied(home.client()) == 403
    assert denied(home.client("admin"), {"Origin": "https://fleet.example"}) == 403
    assert denied(robot, {"Origin": "https://fleet.example"}) == 403
    assert denied(robot, {"Cookie": "anything=1"}) == 403
    assert denied(robot, {"Cookie": f"{COOKIE}=x"}) == 403
    assert denied(robot, {"Authorization": "Robot ropod_001:abr_wrong"}) == 401
    assert denied(home.token_client()) == 403


def test_a_robot_with_the_key_of_another_is_refused(home: House) -> None:
    client = home.client()
    client.headers["Authorization"] = f"Robot ropod_002:{home.keys['ropod_001']}"
    assert denied(client) == 401
    assert client.request("HEAD", JOURNAL, headers=about()).status_code == 401


def test_which_robot_it_is_its_key_says(home: House) -> None:
    hello = Hello("ropod_002", STORE, "boot", {}, "", 0, 0, "1")
    with home.robot_client("ropod_001").websocket_connect("/link/v1") as socket:
        socket.send_bytes(encode(hello))
        answer = from_server(socket.receive_bytes())
    assert isinstance(answer, Bye) and answer.for_good
    with home.robot_client("ropod_002").websocket_connect("/link/v1") as socket:
        socket.send_bytes(encode(hello))
        assert isinstance(from_server(socket.receive_bytes()), Welcome)


def test_what_is_no_frame_ends_the_connection(home: House) -> None:
    with home.robot_client().websocket_connect("/link/v1") as socket:
        socket.send_bytes(b"\x00" * 100)
        assert isinstance(from_server(socket.receive_bytes()), Bye)


def test_people_and_tokens_hand_nothing_in(home: House) -> None:
    for client in (home.client("admin"), home.token_client("admin")):
        assert client.patch(JOURNAL, content=CONTENT, headers=piece(CONTENT)).status_code == 403
    assert home.client().head(JOURNAL, headers=about()).status_code == 401


def test_pieces_go_on_where_they_ended(home: House) -> None:
    robot, content = home.robot_client(), b"resumed" * 100
    first = piece(content) | {uploads.CRC: str(zlib.crc32(content[:300]))}
    assert robot.patch(JOURNAL, content=content[:300], headers=first).status_code == 204
    head = robot.head(JOURNAL, headers=about(content))
    assert (head.status_code, head.headers[uploads.OFFSET]) == (200, "300")
    again = robot.patch(JOURNAL, content=content[:300], headers=first)
    assert (again.status_code, again.headers[uploads.OFFSET]) == (409, "300")
    assert (
        home.robot_client("ropod_002").head(JOURNAL, headers=about(content)).headers[uploads.OFFSET]
        == "0"
    ), "each robot has its own"


def test_what_does_not_hold_is_quarantined(home: House) -> None:
    robot = home.robot_client()
    assert robot.patch(JOURNAL, content=CONTENT, headers=piece(CONTENT)).status_code == 204
    ended = robot.post(JOURNAL, content=msgspec.json.encode(Proof()), headers=about())
    assert (ended.status_code, ended.headers[uploads.STATE]) == (200, "quarantined")
    assert ended.json()["state"] == "quarantined" and ended.json()["reason"]
    assert (home.services.folder / "quarantine" / "ropod_001" / STORE).is_dir()


@pytest.mark.parametrize(
    "path",
    [
        f"/link/v1/journals/{STORE}/journal/..%2f..%2fserver.db",
        f"/link/v1/journals/{STORE}/..%2f..%2ftls/000001-aaaa-0001.mcap",
        "/link/v1/journals/..%2f..%2f..%2fetc/journal/000001-aaaa-0001.mcap",
        f"/link/v1/journals/{STORE}/journal/%2e%2e",
        f"/link/v1/journals/{STORE}/secret/000001-aaaa-0001.mcap",
        f"/link/v1/journals/{STORE}/journal/000001-aaaa-0001.mcap%00",
        f"/link/v1/journals/{STORE}/journal/{'a' * 65}",
    ],
)
def test_no_name_leads_out_of_the_folder(home: House, path: str) -> None:
    before = sorted(home.services.folder.rglob("*"))
    found = home.robot_client().patch(path, content=CONTENT, headers=piece(CONTENT))
    assert found.status_code in (400, 404, 422)
    assert sorted(home.services.folder.rglob("*")) == before


def test_what_is_no_number_too_large_or_no_proof_is_refused(home: House) -> None:
    robot = home.robot_client()
    for wrong in ("", "-1", "1e3", "9" * 30, "٣"):
        headers = {k.encode(): v.encode() for k, v in piece(CONTENT).items()}
        headers[uploads.OFFSET.encode()] = wrong.encode()
        assert robot.patch(JOURNAL, content=CONTENT, headers=headers).status_code == 400
    large = b"x" * (PIECE_BYTES + 1)
    assert robot.patch(JOURNAL, content=large, headers=piece(large)).status_code == 413
    assert robot.post(JOURNAL, content=b"{", headers=about(b"other")).status_code == 400


def test_a_robot_that_sends_very_much_at_once_is_sent_away(home: House) -> None:
    threads, client = home.services.threads, home.robot_client("ropod_001")
    with ExitStack() as busy:
        for _ in range(EACH):
            busy.enter_context(threads.turn("ropod_001"))
        assert client.patch(JOURNAL, content=CONTENT, headers=piece(CONTENT)).status_code == 503
        assert client.post(JOURNAL, headers=about()).status_code == 503
        folder = f"/link/v1/folders/{'0' * 64}"
        assert client.put(folder, content=b"x").status_code == 503
        other = home.robot_client("ropod_002")
        assert other.patch(JOURNAL, content=CONTENT, headers=piece(CONTENT)).status_code != 503
    assert client.put(folder, content=b"x").status_code == 400


def test_a_full_disk_takes_nothing(home: House, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(home.services.keeping, "_room", ServerDisk(100 << 30, 500 << 20))
    full = home.robot_client().patch(JOURNAL, content=CONTENT, headers=piece(CONTENT))
    assert full.status_code == 507


def test_without_tls_of_its_own_there_is_no_authority(home: House) -> None:
    assert home.client().get("/link/v1/ca.pem").status_code == 404


class FakeSocket:
    """A connection that stores sent frames and waits for frames that never arrive."""

    def __init__(self) -> None:
        self.sent: list[ServerFrame] = []
        self.up: asyncio.Queue[bytes | None] = asyncio.Queue()

    async def receive(self) -> bytes:
        data = await self.up.get()
        if data is None:
            raise SocketClosedError
        return data

    async def send(self, data: bytes) -> None:
        self.sent.append(from_server(data))

    async def close(self) -> None:
        self.up.put_nowait(None)


@pytest.mark.parametrize("how", ["revoked", "replaced", "disabled"])
def test_a_key_that_stops_ends_the_open_connection_at_once(tmp_path: Path, how: str) -> None:
    async def scene(home: House) -> list[ServerFrame]:
        services, socket = home.services, FakeSocket()
        services.bus.attach(asyncio.get_running_loop())
        key_id = home.keys["ropod_001"].split("_")[1]
        serving = asyncio.create_task(services.links.serve(socket, "ropod_001", key_id))
        looking = asyncio.create_task(services.revocation.run())
        socket.up.put_nowait(encode(Hello("ropod_001", STORE, "boot", {}, "", 0, 0, "1")))
        while "ropod_001" not in services.links.robots:
            await asyncio.sleep(0.01)
        _stop(home, how)
        services.bus.publish(ServerChange("robot", "ropod_001"))
        await asyncio.wait_for(serving, PATIENCE_S)
        looking.cancel()
        return socket.sent

    with house(tmp_path / "server") as home:
        sent = asyncio.run(scene(home))
    assert isinstance(sent[-1], Bye) and sent[-1].for_good


def _stop(home: House, how: str) -> None:
    now_ns = home.clock.wall_ns()
    with home.services.database.begin() as connection:
        if how == "revoked":
            revoke_keys(connection, now_ns, "ropod_001")
        elif how == "replaced":
            rotate_key(connection, now_ns, "ropod_001", overlap_ns=0)
        else:
            disable_robot(connection, now_ns, "ropod_001")
