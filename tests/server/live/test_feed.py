"""The feed over real sockets: a snapshot, what changes, and nothing that is not for one's eyes."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable, Sequence
from typing import Any

import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus

from amberbox.blackbox.journal import channels
from amberbox.server.accounts.robots import regroup_robot
from amberbox.server.accounts.sessions import revoke_sessions
from amberbox.server.accounts.tokens import add_token
from amberbox.server.accounts.users import find_user
from amberbox.server.bus import Kind, ServerChange
from amberbox.server.derived import RecordStores
from amberbox.server.http.auth import COOKIE
from amberbox.server.live import feed as feed_module
from amberbox.server.live.feed import MOST_EACH
from amberbox.server.live.listener import ChangeRing
from amberbox.server.live.records import LONGEST, StatusRecord, decode_record
from amberbox.testing.clock import PATIENCE_S, until
from tests.server.house import URL, House
from tests.server.live.listening import Stage, ask, hear, hear_up_to, is_about, stage
from tests.server.state.lives import put_alarm


def token(home: House, owner: str, *scopes: str) -> dict[str, str]:
    with home.services.database.begin() as connection:
        user = find_user(connection, owner)
        made = add_token(connection, home.clock.wall_ns(), user, "t", scopes)
    return {"Authorization": f"Bearer {made.text}"}


def test_a_snapshot_then_what_changes(home: House) -> None:
    async def scene() -> None:
        async with stage(home) as on, on.browser("viewer") as socket:
            await ask(socket)
            first = await hear(socket, "snapshot")
            assert [card["robot"] for card in first["data"]["robots"]] == [
                "ropod_001", "ropod_002", "ropod_003"
            ]  # fmt: skip
            on.status("ropod_001", "error", reason="front is dead")
            change = await hear(socket, "status")
            assert change["robot"] == "ropod_001" and change["number"] > first["number"]
            (laser,) = change["data"]
            assert (laser["component"], laser["level"]) == ("laser", "error")
            home.services.bus.publish(ServerChange("connected", "ropod_002", {}))
            seen = await hear(socket, "presence")
            assert (seen["robot"], seen["data"]) == ("ropod_002", {"online": True})

    asyncio.run(scene())


def test_changes_of_commands_are_for_who_may_see_commands(home: House) -> None:
    async def scene() -> None:
        blind = token(home, "technician", "read:status")
        async with stage(home) as on, on.browser("nurse") as nurse, on.program(blind) as program:
            for socket in (nurse, program):
                await ask(socket)
                await hear(socket, "snapshot")
            changes: Sequence[Kind] = ("command", "answered", "lease")
            for number, kind in enumerate(changes):
                for robot in ("ropod_003", "ropod_001", ""):
                    home.services.bus.publish(ServerChange(kind, robot, {"ids": [str(number)]}))
                heard = await hear(nurse, "command")
                assert (heard["robot"], heard["data"]) == ("ropod_001", {"ids": [str(number)]})
            on.say("ropod_001", channels.COMMAND, id="0", state="report", text="half way")
            heard = await hear(nurse, "command")
            assert (heard["robot"], heard["data"]) == ("ropod_001", {"ids": []})
            home.services.bus.publish(ServerChange("gone", "ropod_001", {}))
            kinds: list[str] = []
            while "presence" not in kinds:
                kinds += [message["kind"] for message in json.loads(await program.recv())]
            assert "command" not in kinds

    asyncio.run(scene())


def test_a_status_that_is_as_before_or_late_is_no_news(home: House) -> None:
    async def scene() -> None:
        async with stage(home) as on, on.browser("viewer") as socket:
            await ask(socket)
            await hear(socket, "snapshot")
            on.status("ropod_001", "ok", measured_ns=1)
            await hear(socket, "status")
            on.status("ropod_001", "ok", measured_ns=2)
            on.seq = 0
            on.status("ropod_001", "error")
            on.status("ropod_001", component="last")
            (only,) = await hear_up_to(socket, is_about("last"))
            assert [status["component"] for status in only["data"]] == ["last"]

    asyncio.run(scene())


def test_robots_of_other_groups_never_appear(home: House) -> None:
    async def scene() -> None:
        async with stage(home) as on, on.browser("nurse") as socket:
            both = ("ropod_003", "ropod_001")
            await ask(socket, robots=both, live={robot: ["odom/x"] for robot in both})
            first = await hear(socket, "snapshot")
            assert [card["robot"] for card in first["data"]["robots"]] == ["ropod_001"]
            await _watched(home, "ropod_001", "odom/x")
            on.status("ropod_003")
            on.say("ropod_003", channels.EVENT, kind="x", text="y")
            home.services.bus.publish(ServerChange("alarm", "ropod_003", {"id": "a"}))
            put_alarm(home, 7, "ropod_001", "ropod_003")
            home.services.bus.publish(ServerChange("alarm", "", {"id": 7}))
            on.status("ropod_001")
            for robot in both:
                values = {"values": {"odom/x": (1, 1.0)}}
                home.services.bus.publish(ServerChange("live", robot, values))
            found = await hear_up_to(socket, _completes({"alarm", "status", "live"}))
            assert {message["robot"] for message in found} == {"ropod_001"}
            assert [m["data"]["id"] for m in found if m["kind"] == "alarm"] == [7]
            assert "ropod_003" not in home.services.links._watched

    asyncio.run(scene())


def _completes(kinds: set[str]) -> Callable[[dict[str, Any]], bool]:
    """Return what knows the message with which one of each kind was heard."""
    missing = set(kinds)

    def is_last(message: dict[str, Any]) -> bool:
        missing.discard(message["kind"])
        return not missing

    return is_last


async def _watched(home: House, robot: str, *variables: str) -> None:
    """Wait until a robot is asked for just these variables."""
    watched = home.services.links._watched
    await until(lambda: watched.get(robot) == variables, f"{variables} of {robot}")


def test_kinds_and_robots_are_chosen(home: House) -> None:
    async def scene() -> None:
        async with stage(home) as on, on.browser("viewer") as socket:
            await ask(socket, robots=["ropod_002"], kinds=["event"])
            first = await hear(socket, "snapshot")
            assert first["data"]["statuses"] == {}
            on.status("ropod_002")
            on.say("ropod_001", channels.EVENT, kind="x", text="not asked for")
            on.say("ropod_002", channels.EVENT, kind="power", text="low")
            await on.numbered()
            on.say("ropod_002", channels.EVENT, kind="power", text="off")
            found = await hear_up_to(socket, lambda m: "off" in json.dumps(m))
            assert {message["kind"] for message in found} == {"event"}
            assert [event["text"] for m in found for event in m["data"]] == ["low", "off"]

    asyncio.run(scene())


def test_values_alone_are_no_news_of_levels(home: House) -> None:
    volts = {"name": "volts", "type": "float", "value": 24.0}

    async def scene() -> None:
        async with stage(home) as on, on.browser("viewer") as socket:
            await ask(socket, kinds=["levels"])
            assert (await hear(socket, "snapshot"))["data"]["statuses"] == {}
            on.status("ropod_001", "warn", state="weak", reason="24 volts for 3.2 s")
            news = await hear(socket, "levels")
            assert news["data"] == [
                {"component": "laser", "mode": "", "level": "warn", "state": "weak"}
            ]
            for reason in ("23.5 volts for 4.2 s", "22 volts for 5 s"):
                on.status("ropod_001", "warn", state="weak", reason=reason, outputs=[volts])
            on.status("ropod_001", component="last")
            (only,) = await hear_up_to(socket, is_about("last", "levels"))
            assert [level["component"] for level in only["data"]] == ["last"]
            for more in ({"reason": "none"}, {"blocked_by": ["power"]}, {"state": "off"}):
                on.status("ropod_001", "warn", **more)
                assert (await hear(socket, "levels"))["robot"] == "ropod_001"

    asyncio.run(scene())


def test_who_looks_at_everything_hears_each_change_once(home: House) -> None:
    async def scene() -> None:
        async with stage(home) as on, on.browser("viewer") as socket:
            await ask(socket)
            await hear(socket, "snapshot")
            on.status("ropod_001", "warn")
            await on.numbered()
            on.status("ropod_001", component="last")
            found = await hear_up_to(socket, is_about("last"))
            assert [m["kind"] for m in found] == ["status", "status"]
            await ask(socket, kinds=["levels", "status"])
            await hear(socket, "snapshot")
            on.status("ropod_001", "error")
            await on.numbered()
            on.status("ropod_001", "error", component="last")
            found = await hear_up_to(socket, is_about("last", "levels"))
            assert [m["kind"] for m in found] == ["status", "levels"] * 2

    asyncio.run(scene())


def test_who_hears_nothing_for_a_while_goes_on_without_a_hole(home: House) -> None:
    async def scene() -> None:
        async with stage(home) as on, on.browser("viewer") as socket:
            await ask(socket, kinds=["levels"])
            await hear(socket, "snapshot")
            for value in range(30):
                volts = {"name": "volts", "type": "float", "value": value}
                on.status("ropod_001", outputs=[volts])
                await on.numbered()
            await hear(socket, "ping")
            on.status("ropod_001", "error")
            await on.numbered()
            on.status("ropod_001", component="last")
            found = await hear_up_to(socket, is_about("last", "levels"))
            assert {message["kind"] for message in found} == {"levels"}
            assert "error" in [level["level"] for message in found for level in message["data"]]

    asyncio.run(scene())


def test_of_jobs_only_the_owner_hears(home: House) -> None:
    async def scene() -> None:
        async with (
            stage(home) as on,
            on.browser("technician") as owner,
            on.browser("admin") as other,
        ):
            for socket in (owner, other):
                await ask(socket)
                await hear(socket, "snapshot")
            told = {"id": "j1", "owner": "technician"}
            home.services.bus.publish(ServerChange("job", "ropod_001", told))
            on.status("ropod_001")
            assert (await hear(owner, "job"))["data"]["id"] == "j1"
            found = await hear_up_to(other, is_about("laser"))
            assert {message["kind"] for message in found} == {"status"}

    asyncio.run(scene())


def test_who_may_ask_for_data_hears_of_windows_from_robots(home: House) -> None:
    async def scene() -> None:
        async with stage(home) as on, on.browser("viewer") as socket:
            await ask(socket, kinds=["fetch"])
            await hear(socket, "snapshot")
            client = home.client("technician")
            window = {"from": "now-1h", "to": "now-30m"}
            made = await asyncio.to_thread(
                client.post, "/api/v1/robots/ropod_001/fetches", json=window
            )
            id = made.json()["id"]
            told = await hear(socket, "fetch")
            assert (told["robot"], told["data"]) == ("ropod_001", {"id": id})
            await asyncio.to_thread(client.delete, f"/api/v1/robots/ropod_001/fetches/{id}")
            assert (await hear(socket, "fetch"))["data"] == {"id": id}

    asyncio.run(scene())


def test_a_token_hears_what_its_scopes_allow(home: House) -> None:
    async def scene() -> None:
        async with stage(home) as on:
            async with on.program(token(home, "technician", "read:status")) as socket:
                await ask(socket)
                await hear(socket, "snapshot")
                on.say("ropod_001", channels.EVENT, kind="x", text="y")
                home.services.bus.publish(ServerChange("alarm", "ropod_001", {"id": "a"}))
                on.status("ropod_001")
                found = await hear_up_to(socket, is_about("laser"))
                assert {message["kind"] for message in found} == {"status"}
            with pytest.raises(InvalidStatus):
                await on.program(token(home, "technician", "read:data"))

    asyncio.run(scene())


def test_only_pages_of_this_server_get_in(home: House) -> None:
    async def refused(on: Stage, headers: dict[str, str]) -> int:
        with pytest.raises(InvalidStatus) as caught:
            await on.program(headers)
        return caught.value.response.status_code

    async def scene() -> None:
        async with stage(home) as on:
            cookie = {"Cookie": f"{COOKIE}={on.session('admin')}"}
            key = token(home, "technician", "read:status")
            for headers in (
                {**cookie, "Origin": "https://evil.example"},
                {**cookie, "Origin": "null"},
                cookie,
                {**key, "Origin": URL},
                {**key, **cookie},
                {**key, **cookie, "Origin": URL},
            ):
                assert await refused(on, headers) == 403, headers
            assert await refused(on, {"Origin": URL}) in (401, 403)
            robot = f"Robot ropod_001:{home.keys['ropod_001']}"
            assert await refused(on, {"Authorization": robot}) == 403
            async with on.program(key) as socket:
                await ask(socket)
                await hear(socket, "snapshot")

    asyncio.run(scene())


def test_an_ended_session_closes_its_socket(home: House) -> None:
    async def scene() -> None:
        async with stage(home) as on, on.browser("viewer") as socket:
            await ask(socket)
            await hear(socket, "snapshot")
            with home.services.database.begin() as connection:
                revoke_sessions(connection, find_user(connection, "viewer").user_id)
            home.services.bus.publish(ServerChange("account", data={"name": "viewer"}))
            on.status("ropod_001", "error")
            with pytest.raises(ConnectionClosed) as caught:
                async with asyncio.timeout(PATIENCE_S):
                    while True:
                        await socket.recv()
            assert caught.value.rcvd is not None and caught.value.rcvd.code == 4401

    asyncio.run(scene())


def test_a_session_that_runs_out_is_found_without_being_told(
    home: House, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(feed_module, "CHECK_S", 0.1)

    async def scene() -> None:
        async with stage(home) as on, on.browser("viewer") as socket:
            await ask(socket)
            await hear(socket, "snapshot")
            home.clock.advance(10 * 24 * 3600)
            with pytest.raises(ConnectionClosed) as caught:
                await hear(socket, "nothing")
            assert caught.value.rcvd is not None and caught.value.rcvd.code == 4401

    asyncio.run(scene())


def test_a_robot_that_leaves_the_group_is_gone_from_the_next_snapshot(home: House) -> None:
    async def scene() -> None:
        async with stage(home) as on, on.browser("nurse") as socket:
            await ask(socket)
            await hear(socket, "snapshot")
            with home.services.database.begin() as connection:
                regroup_robot(connection, "ropod_002", ["kitchen"])
            home.services.bus.publish(ServerChange("robot", "ropod_002"))
            again = await hear(socket, "snapshot")
            assert [card["robot"] for card in again["data"]["robots"]] == ["ropod_001"]

    asyncio.run(scene())


def test_who_comes_back_goes_on_where_it_was(home: House) -> None:
    async def scene() -> None:
        async with stage(home) as on:
            async with on.browser("viewer") as socket:
                await ask(socket)
                number = (await hear(socket, "snapshot"))["number"]
            on.status("ropod_001", "warn")
            await on.numbered()
            async with on.browser("viewer") as socket:
                await ask(socket, resume=number)
                found = await hear_up_to(socket, is_about("laser"))
                assert [message["kind"] for message in found] == ["status"]
            for unknown in (number - 1, number + 1000, 5):
                async with on.browser("viewer") as socket:
                    await ask(socket, resume=unknown)
                    found = await hear_up_to(socket, lambda m: m["kind"] == "snapshot")
                    home.services.bus.publish(ServerChange("gone", "ropod_001", {}))
                    found += await hear_up_to(socket, lambda m: m["kind"] == "presence")
                    assert [message["kind"] for message in found] == ["snapshot", "presence"]

    asyncio.run(scene())


def test_a_slow_reader_is_told_what_it_missed_and_holds_nobody_up(
    home: House, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def scene() -> None:
        async with stage(home) as on, on.browser("viewer") as slow, on.browser("admin") as quick:
            for socket in (slow, quick):
                await ask(socket)
                await hear(socket, "snapshot")
            slow.transport.pause_reading()  # its window fills, then the server's buffer
            latest = 0.0
            for number in range(60):
                on.status("ropod_001", "ok", reason=f"{number}" + "x" * 200_000)
                began = asyncio.get_running_loop().time()
                await hear(quick, "status")
                latest = max(latest, asyncio.get_running_loop().time() - began)
            assert latest < feed_module.SEND_S / 2
            monkeypatch.setattr(feed_module, "BEHIND_S", 0.01)
            slow.transport.resume_reading()
            await hear(slow, "missed")
            snapshot = await hear(slow, "snapshot")
            assert snapshot["number"] == home.services.feed.ring.number

    asyncio.run(scene())


def test_what_cannot_be_understood_closes_the_socket(home: House) -> None:
    async def scene() -> None:
        many = {"live": {"ropod_001": ["x" * 600]}}
        async with stage(home) as on:
            for text in ("{", json.dumps({"kinds": ["laundry"]}), json.dumps(many), b"\x00"):
                async with on.browser("viewer") as socket:
                    await socket.send(text)
                    with pytest.raises(ConnectionClosed) as caught:
                        await hear(socket, "nothing")
                    assert caught.value.rcvd is not None and caught.value.rcvd.code == 4400

    asyncio.run(scene())


def test_sockets_of_one_person_are_counted(home: House) -> None:
    async def scene() -> None:
        async with stage(home) as on:
            opened = [await on.browser("viewer") for _ in range(MOST_EACH)]
            with pytest.raises(InvalidStatus):
                await on.browser("viewer")
            async with on.browser("admin"):
                pass
            for socket in opened:
                await socket.close()
            await until(lambda: len(home.services.feed.listeners) < MOST_EACH, "they are gone")
            async with on.browser("viewer"):
                pass

    asyncio.run(scene())


def test_live_values_are_asked_once_and_sent_to_those_who_look(home: House) -> None:
    async def scene() -> None:
        async with stage(home) as on, on.browser("viewer") as one, on.browser("admin") as other:
            await ask(one, live={"ropod_001": ["odom/x"]})
            await ask(other, live={"ropod_001": ["odom/y", "odom/x"]})
            for socket in (one, other):
                await hear(socket, "snapshot")
            await _watched(home, "ropod_001", "odom/x", "odom/y")
            values: dict[str, Any] = {"odom/x": (1, 1.5), "odom/y": (1, "up"), "secret": (1, 9.0)}
            began_s = asyncio.get_running_loop().time()
            for _ in range(20):
                home.services.bus.publish(ServerChange("live", "ropod_001", {"values": values}))
                await asyncio.sleep(0.02)
            await hear(one, "live")
            values["odom/x"] = (2, 2.5)
            home.services.bus.publish(ServerChange("live", "ropod_001", {"values": values}))
            found = await hear_up_to(one, lambda m: m["data"]["odom/x"]["value"] == 2.5)
            took_s = asyncio.get_running_loop().time() - began_s
            assert len(found) <= took_s / feed_module.EVERY_S
            assert {name: v["value"] for name, v in found[-1]["data"].items()} == {"odom/x": 2.5}
            both = (await hear(other, "live"))["data"]
            assert {name: v["value"] for name, v in both.items()} == {"odom/x": 1.5, "odom/y": "up"}
            await other.close()
            await _watched(home, "ropod_001", "odom/x")

    asyncio.run(scene())


def test_what_a_robot_says_cannot_break_the_feed(home: House) -> None:
    async def scene() -> None:
        async with stage(home) as on, on.browser("viewer") as socket:
            await ask(socket)
            await hear(socket, "snapshot")
            on.say("ropod_001", channels.STATUS, component=["no", "text"])
            on.say("ropod_001", channels.STATUS, component="big", since_ns=10**25, level="evil")
            on.say("ropod_001", channels.STATUS, component="big", since_ns=2**63, level="evil")
            on.say("ropod_001", channels.DIAGNOSIS, id=5)
            on.status("ropod_001", "ok", component='"]}<script>')
            heard = await hear_up_to(socket, is_about('"]}<script>'))
            found = [status for message in heard for status in message["data"]]
            assert {s["component"] for s in found} == {"big", '"]}<script>'}
            assert next(s for s in found if s["component"] == "big")["since"] is None

    asyncio.run(scene())


def test_the_ring_is_bounded_by_count_and_bytes() -> None:
    ring = ChangeRing(1_000_000, held=10, held_bytes=10_000)
    for number in range(50):
        ring.add("event", "r", number, 0.0)
    assert [delta.number for delta in ring.after(0)] == list(range(1041, 1051))
    assert ring.holds(1040) and ring.holds(1050) and not ring.holds(1039) and not ring.holds(1051)
    ring.add("event", "r", "x" * 9_800, 0.0)
    assert len(list(ring.after(0))) < 4


def test_a_robot_whose_past_cannot_be_read_ends_nothing(
    home: House, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Reading damaged columns may raise any exception of the library."""
    state, read = home.services.feed.state, list[str]()

    def load(stores: RecordStores, robot: str) -> None:
        read.append(robot)
        raise KeyError(robot)

    async def scene() -> None:
        running = asyncio.create_task(state.run())
        while len(read) < 3:
            await asyncio.sleep(0.01)
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)
        assert running.cancelled()

    monkeypatch.setattr(state.latest, "load", load)
    asyncio.run(asyncio.wait_for(scene(), PATIENCE_S))
    assert read == ["ropod_001", "ropod_002", "ropod_003"]


def test_what_fails_in_the_feed_leaves_nothing_behind_that_goes_on(
    home: House, monkeypatch: pytest.MonkeyPatch
) -> None:
    feed = home.services.feed

    async def fails() -> None:
        raise KeyError

    async def scene() -> int:
        before = len(asyncio.all_tasks())
        with pytest.raises(ExceptionGroup):
            await feed.run()
        return len(asyncio.all_tasks()) - before

    monkeypatch.setattr(feed, "_lives", fails)
    assert asyncio.run(asyncio.wait_for(scene(), PATIENCE_S)) == 0


def test_a_record_that_is_too_long_to_look_at_is_passed_over() -> None:
    assert (
        decode_record(b'{"component":"x","reason":"%s"}' % (b"a" * LONGEST), StatusRecord) is None
    )
    assert (
        decode_record(b'{"component":"x","reason":"%s"}' % (b"a" * 1000), StatusRecord) is not None
    )
