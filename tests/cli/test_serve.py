"""``amberbox serve`` as a process: a robot joins it over TLS, and none of its rows is lost."""

from __future__ import annotations

import asyncio
import http.client
import json
import resource
import signal
import socket
import ssl
import stat
import subprocess
import time
from collections.abc import Iterator, Mapping
from contextlib import redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

import pytest
from sqlalchemy import select

from amberbox.blackbox.retention.maintenance import seal
from amberbox.blackbox.signing.keys import open_keys
from amberbox.blackbox.store.store import open_store
from amberbox.cli.main import main
from amberbox.core.tls import PinError, fingerprint
from amberbox.link.connection import LinkOptions, LinkRefusedError, dial, tls_context
from amberbox.link.frames import Bye, Hello, encode, from_server
from amberbox.link.join_line import JoinLine, read_join_line
from amberbox.link.uploader import HttpTransport, JournalCopier
from amberbox.server import settings
from amberbox.server.accounts.robots import revoke_keys
from amberbox.server.archive.retention import OPTION, ConfirmedTime
from amberbox.server.database import ServerDatabase
from amberbox.server.schema import AUDIT, COMMITTED, JOURNALS, ROW
from amberbox.testing.clock import PATIENCE_S
from tests.link.robot.rig import Watcher, client_of, held, linked, recorded, until
from tests.support.processes import command, free_port

PASSWORD = "four words without meaning"


@dataclass
class Server:
    """A server in a process of its own."""

    data: Path
    port: int
    process: subprocess.Popen[str]
    context: ssl.SSLContext | None = None

    def ask(
        self, path: str, method: str = "GET", body: bytes | None = None,
        headers: Mapping[str, str] | None = None,
    ) -> tuple[int, bytes, Mapping[str, str]]:  # fmt: skip
        """Send one request; raises OSError while the server does not answer."""
        if self.context is None:
            client = http.client.HTTPConnection("127.0.0.1", self.port, timeout=PATIENCE_S)
        else:
            client = http.client.HTTPSConnection(
                "localhost", self.port, timeout=PATIENCE_S, context=self.context
            )
        try:
            client.request(method, path, body, dict(headers or {}))
            answer = client.getresponse()
            return answer.status, answer.read(), dict(answer.headers)
        finally:
            client.close()

    def await_answer(self) -> None:
        """Wait until it answers."""
        for _ in range(6000):
            assert self.process.poll() is None, self.process.communicate()
            try:
                self.ask("/setup")
                return
            except OSError:
                time.sleep(0.01)
        raise AssertionError("it does not answer")

    def stop(self) -> tuple[int, str]:
        """End it as systemd does; return its status and output."""
        self.process.send_signal(signal.SIGTERM)
        _, said = self.process.communicate(timeout=PATIENCE_S)
        return self.process.returncode, said


def started(data: Path, *words: object, context: ssl.SSLContext | None = None) -> Server:
    port = free_port()
    process = subprocess.Popen(
        command("serve", "--data", data, "--port", port, *words), stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    server = Server(data, port, process, context)
    server.await_answer()
    return server


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """A server with its own TLS certificate, listening on all interfaces, with its first admin."""
    data = tmp_path_factory.mktemp("serve") / "data"
    assert main(["serve", "cert", "--data", str(data), "--host", "localhost"]) == 0
    context = ssl.create_default_context(cafile=str(data / "tls" / "ca.pem"))
    found = started(data, "--host", "0.0.0.0", context=context)
    form = {"name": "anna", "password": PASSWORD, "again": PASSWORD}
    kind = {"Content-Type": "application/x-www-form-urlencoded"}
    assert found.ask("/setup", "POST", urlencode(form).encode(), kind)[0] == 200
    yield found
    if found.process.poll() is None:
        found.stop()


@pytest.fixture(scope="module")
def line(server: Server) -> JoinLine:
    """What a robot is given, while the server runs."""
    done = subprocess.run(
        command("serve", "add-robot", "r1", "--data", server.data), capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return read_join_line(done.stdout)


def options_of(line: JoinLine) -> LinkOptions:
    return LinkOptions(line.url, line.robot, line.key, line.ca)


def test_a_second_process_on_the_folder_is_told_who_is_there(server: Server) -> None:
    second = subprocess.run(
        command("serve", "--data", server.data, "--port", free_port()),
        capture_output=True,
        text=True,
    )
    assert second.returncode == 2
    assert f"process {server.process.pid}" in second.stderr
    assert "hint: stop that one first" in second.stderr


def test_who_was_made_admin_signs_in(server: Server) -> None:
    body = json.dumps({"name": "anna", "password": PASSWORD}).encode()
    status, answer, headers = server.ask(
        "/api/v1/session", "POST", body, {"Content-Type": "application/json"}
    )
    assert (status, json.loads(answer)["role"]) == (200, "admin")
    assert "Secure" in headers["set-cookie"] and "strict-transport-security" in headers
    assert server.ask("/setup")[0] == 404
    assert not (server.data / "setup-code").exists()


def test_a_robot_pins_the_authority(server: Server, line: JoinLine, tmp_path: Path) -> None:
    assert line.url == f"https://localhost:{server.port}"
    assert fingerprint(server.ask("/link/v1/ca.pem")[1]) == line.ca
    assert tls_context(line.url, line.ca, tmp_path) is not None
    with pytest.raises(PinError):
        tls_context(line.url, "0" * 64, tmp_path)


def test_what_a_robot_says_arrives_and_its_journals_become_columns(
    server: Server, line: JoinLine, tmp_path: Path
) -> None:
    path = tmp_path / "store"
    watcher = Watcher(path)
    open_keys(watcher.store)
    watcher.write(50, 3)
    client = client_of(watcher.store, 0)
    client.options = options_of(line)
    with_database = ServerDatabase(server.data / "server.db", read_only=True)

    async def scene() -> None:
        async with linked(client):
            await until(lambda: len(held(with_database)) == 53)
            assert held(with_database) == recorded(path)
            watcher.close()
            seal(open_store(path))
            context = await asyncio.to_thread(tls_context, line.url, line.ca, path)
            sending = HttpTransport(client.options, lambda: context)
            copier = JournalCopier(open_store(path), client.options, sending)
            while await asyncio.to_thread(copier.step):
                pass
            sending.close()
            await until(lambda: committed(with_database) == {"committed"})
            await until(lambda: held(with_database) == {})

    asyncio.run(scene())
    with with_database.reading() as connection:
        assert connection.execute(select(COMMITTED.c.to_seq)).scalars().all() != []
        assert connection.execute(select(ROW)).first() is None, "the cache is empty again"
    with_database.close()
    assert main(["items", str(server.data)]) == 0


def committed(database: ServerDatabase) -> set[str]:
    with database.reading() as connection:
        return set(connection.execute(select(JOURNALS.c.state)).scalars())


def hello(robot: str) -> Any:
    return Hello(robot, "store", "boot", {}, "", 0, 0, "1")


def test_a_robot_that_claims_to_be_another_is_sent_away(
    server: Server, line: JoinLine, tmp_path: Path
) -> None:
    async def scene() -> None:
        context = await asyncio.to_thread(tls_context, line.url, line.ca, tmp_path)
        socket_ = await dial(options_of(line), context)
        await socket_.send(encode(hello("r2")))
        answer = from_server(await socket_.receive())
        assert isinstance(answer, Bye) and answer.for_good
        await socket_.close()
        wrong = LinkOptions(line.url, "r2", line.key, line.ca)
        with pytest.raises(LinkRefusedError):
            await dial(wrong, context)

    asyncio.run(scene())


def test_a_key_that_is_revoked_ends_the_open_connection(
    server: Server, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    add = ["serve", "add-robot", "r3", "--data", str(server.data), "--group", "new"]
    assert main(add) == 0
    mine = read_join_line(capsys.readouterr().out)

    async def scene() -> None:
        context = await asyncio.to_thread(tls_context, mine.url, mine.ca, tmp_path)
        socket_ = await dial(options_of(mine), context)
        await socket_.send(encode(hello("r3")))
        await socket_.receive()
        database = ServerDatabase(server.data / "server.db")
        with database.begin() as connection:
            revoke_keys(connection, time.time_ns(), "r3")
        database.close()
        answer = from_server(await asyncio.wait_for(socket_.receive(), PATIENCE_S))
        assert isinstance(answer, Bye) and "key" in answer.reason
        with pytest.raises(LinkRefusedError):
            await dial(options_of(mine), context)

    asyncio.run(scene())


def test_a_line_goes_to_a_file_that_nobody_else_reads(
    server: Server, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, data = tmp_path / "line", ["--data", str(server.data)]
    assert main(["serve", "add-robot", "r8", *data, "--line-file", str(file)]) == 0
    assert "abr_" not in capsys.readouterr().out
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    assert read_join_line(file.read_text()).robot == "r8"
    assert main(["serve", "add-robot", "r9", *data, "--line-file", str(file)]) == 2
    assert "is there already" in capsys.readouterr().err
    with (tmp_path / "open").open("w") as out, redirect_stdout(out):
        (tmp_path / "open").chmod(0o644)
        assert main(["serve", "add-robot", "r9", *data]) == 0, (
            "the refused one did not add the robot"
        )
    assert "others can read this file" in capsys.readouterr().err


def test_the_audit_log_holds_while_the_server_runs(
    server: Server, line: JoinLine, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["serve", "verify-audit", "--data", str(server.data)]) == 0
    head = capsys.readouterr().out.strip().partition("elsewhere: ")[2]
    assert main(["serve", "verify-audit", "--data", str(server.data), "--head", head]) == 0
    number = head.partition(" ")[0]
    forged = f"{number} {'0' * 64}"
    assert main(["serve", "verify-audit", "--data", str(server.data), "--head", forged]) == 1
    assert "rewritten" in capsys.readouterr().out


def test_a_jump_of_the_clock_is_told_and_confirmed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    database = ServerDatabase(tmp_path / "server.db")
    mark = ConfirmedTime(time.time_ns() - 32 * 86_400 * 10**9, "an earlier boot")
    with database.begin() as connection:
        settings.write(connection, 0, OPTION, mark)
    clock = ["serve", "clock", "--data", str(tmp_path)]
    assert main(clock) == 1
    said = capsys.readouterr().out
    assert "ahead of the confirmed time" in said
    assert f"hint: if it is right: amberbox serve clock --data {tmp_path} --confirm" in said
    assert main([*clock, "--confirm"]) == 0
    assert "confirmed" in capsys.readouterr().out
    assert main(clock) == 0
    with database.reading() as connection:
        assert connection.scalars(select(AUDIT.c.action)).all() == ["clock.confirm"]
    database.close()


def test_it_ends_in_order_and_says_goodbye(server: Server, line: JoinLine, tmp_path: Path) -> None:
    async def scene() -> tuple[int, str]:
        context = await asyncio.to_thread(tls_context, line.url, line.ca, tmp_path)
        socket_ = await dial(options_of(line), context)
        await socket_.send(encode(hello("r1")))
        await socket_.receive()
        ending = asyncio.create_task(asyncio.to_thread(server.stop))
        answer = from_server(await asyncio.wait_for(socket_.receive(), PATIENCE_S))
        assert answer == Bye("the server stops")
        return await ending

    status, said = asyncio.run(scene())
    assert (status, said.partition("\n")[0][:19]) == (0, "To become an admin ")
    log = (server.data / "log" / "access.log").read_text().splitlines()
    assert any(json.loads(entry)["principal"] == "robot:r1" for entry in log)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--host", "0.0.0.0"], "by TLS only"),
        (["--behind-proxy", "10.0.0.5"], "what it is called"),
        (["--host", "256.0.0.1", "--behind-proxy", "10.0.0.5", "--public-url", "https://f.example"],
         "no address of this machine"),
        (["cert"], "needs a name"),
        (["cert", "--host", "a b"], "no name"),
        (["add-robot"], "takes one ID"),
        (["add-robot", "r1"], "no data folder"),
        (["verify-audit"], "no data folder"),
        (["clock"], "no data folder"),
        (["--confirm"], "--confirm for clock"),
        (["certt"], "knows no 'certt'"),
        (["--head", "1 abc"], "--head for verify-audit"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_told(
    tmp_path: Path, words: list[str], said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["serve", *words, "--data", str(tmp_path / "data")]) in (1, 2)
    told = capsys.readouterr().err
    assert said in told and "hint:" in told and "Traceback" not in told


def test_a_port_that_is_taken_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        assert main(["serve", "--data", str(tmp_path), "--port", str(port)]) == 1
    assert "Address already in use" in capsys.readouterr().err


def test_file_limits_are_raised() -> None:
    from amberbox.server.process import raise_file_limit

    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    try:
        resource.setrlimit(resource.RLIMIT_NOFILE, (min(512, hard), hard))
        raise_file_limit()
        assert resource.getrlimit(resource.RLIMIT_NOFILE)[0] >= min(hard, 4096)
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
