"""Changes of an alarm are sent to the destinations that request them: in order, once."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from amberbox.core.clock import NS
from amberbox.monitoring.alarms import FOLLOWS
from amberbox.monitoring.findings import AlarmState
from amberbox.server.alarms import lifecycle
from amberbox.server.alarms.alarm import AlarmSettings
from amberbox.server.alarms.outbox import NotificationMessage, deliver
from amberbox.server.alarms.recipients import NAME, Also, Email, Notifications, Quiet, Smtp, Webhook
from amberbox.server.alarms.store import AlarmRegister
from tests.server.alarms.receivers import mail_server
from tests.server.alarms.stand import Stand, alarm, stand

SECRET = "0123456789abcdef"
BOTH: tuple[Also, ...] = ("acknowledged", "resolved")


def hook(**more: Any) -> Webhook:
    return Webhook("hook", "https://hook.example/", SECRET, **{"also": BOTH, **more})


@pytest.fixture
def home(tmp_path: Path) -> Iterator[Stand]:
    with stand(tmp_path) as one:
        one.set("alarms", AlarmSettings(settle_s=0, quiet_s=60, reopen_s=300))
        one.set(NAME, Notifications(webhooks=(hook(),)))
        one.alarms.step()
        yield one


def events(home: Stand) -> list[str]:
    """Return the messages, by event and number of the alarm."""
    return [f"{message.data['event']} {message.data['id']}" for _, message in home.told]


def acknowledge(home: Stand, number: int = 1) -> None:
    with home.database.begin() as connection:
        register = AlarmRegister(connection)
        found = register.alarm(number)
        assert found is not None
        register.keep(
            found, lifecycle.acknowledged(found, "anna", home.clock.wall_ns(), "on my way")
        )


def say(home: Stand, state: AlarmState, component: str = "laser", **more: Any) -> None:
    home.hear("r1", alarm(home, component, state, **more))
    home.wait(1)


def test_acknowledged_and_resolved_are_told_with_the_same_key(home: Stand) -> None:
    say(home, "open")
    acknowledge(home)
    home.wait(2)
    say(home, "healed")
    home.wait(120, 10)
    assert events(home) == ["opened 1", "acknowledged 1", "resolved 1"]
    data = [message.data for _, message in home.told]
    first = home.told[0][1].key
    assert {one["dedup_key"] for one in data} == {first}
    assert {message.thread for _, message in home.told} == {first}
    assert len({message.key for _, message in home.told}) == 3
    assert data[1]["by"] == "anna" and data[2]["resolution"] == "over"
    assert {one["version"] for one in data} == {1}
    assert [message.subject for _, message in home.told][1:] == [
        "acknowledged: urgent: r1 laser", "resolved: urgent: r1 laser",
    ]  # fmt: skip
    assert "acknowledged by anna 2027-01-15T08:00:0" in home.told[1][1].body


def test_without_asking_nothing_more_is_told(home: Stand) -> None:
    home.set(NAME, Notifications(webhooks=(hook(also=()),)))
    say(home, "open")
    acknowledge(home)
    say(home, "healed")
    home.wait(600, 20)
    assert events(home) == ["opened 1"]


def test_of_an_alarm_that_was_never_told_no_end_is_told(home: Stand) -> None:
    home.set(NAME, Notifications(webhooks=(hook(least="fatal"),)))
    say(home, "open")
    home.set(NAME, Notifications(webhooks=(hook(),)))
    acknowledge(home)
    say(home, "healed")
    home.wait(120, 10)
    assert home.told == []


def test_one_that_flaps_is_told_open_and_resolved_twice_at_most(home: Stand) -> None:
    home.set(NAME, Notifications(webhooks=(hook(),), digest_above=100))
    for count in range(1, 9):
        say(home, "open", count=count)
        home.wait(30, 5)
        say(home, "healed", count=count)
        home.wait(100, 5)
    assert events(home) == ["opened 1", "resolved 1", "opened 1"]
    home.wait(400, 20)
    assert events(home)[3:] == ["resolved 1"]
    assert len({message.data["dedup_key"] for _, message in home.told}) == 1


@pytest.mark.parametrize("restarts", [False, True])
def test_the_order_holds_over_retries_and_restarts(home: Stand, *, restarts: bool) -> None:
    home.trouble = "the answer was 503"
    say(home, "open")
    home.wait(300, 10)  # the next attempt is minutes away
    acknowledge(home)
    say(home, "healed")
    home.wait(70, 10)
    assert [row["kind"] for row in home.outbox()] == ["alarm", "acknowledged", "resolved"]
    home.trouble = ""
    if restarts:
        home.restart()
        home.connect("r1")
    home.wait(3600, 30)
    assert events(home) == ["opened 1", "acknowledged 1", "resolved 1"]


def test_a_change_right_before_a_crash_is_told_after_it(home: Stand) -> None:
    say(home, "open")
    acknowledge(home)
    home.restart()
    home.wait(2)
    assert events(home) == ["opened 1", "acknowledged 1"]


def test_the_end_of_what_never_arrived_fails_with_it(home: Stand) -> None:
    home.trouble = "nobody there"
    say(home, "open")
    say(home, "healed")
    home.wait(24 * 3600, 900)
    home.trouble = ""
    home.wait(3600, 600)
    assert home.told == []
    assert [row["state"] for row in home.outbox()] == ["failed", "failed"]
    assert home.outbox()[1]["trouble"] == "the alarm itself did not arrive"


def test_in_a_digest_what_is_over_stands_once(home: Stand) -> None:
    quiet = Quiet("07:00", "09:00", but="fatal")  # the stand begins at 08:00
    home.set(NAME, Notifications(webhooks=(hook(quiet=quiet),)))
    say(home, "open", "laser")
    say(home, "open", "wheel")
    say(home, "healed", "laser")
    home.wait(600, 20)
    assert home.told == []
    home.wait(3600, 60)
    ((_, digest),) = home.told
    said = [(one["event"], one["id"]) for one in digest.data["alarms"]]
    assert sorted(said) == [("opened", 2), ("resolved", 1)]
    say(home, "healed", "wheel")
    home.wait(120, 10)
    assert (home.told[-1][1].data["event"], home.told[-1][1].data["id"]) == ("resolved", 2)


def test_the_end_waits_for_the_digest_that_tells_of_the_alarm(home: Stand) -> None:
    quiet = Quiet("07:00", "08:01", but="fatal")
    home.set(NAME, Notifications(webhooks=(hook(quiet=quiet),)))
    say(home, "open")
    home.trouble = "the answer was 503"
    home.wait(600, 10)  # the digest was made, and does not arrive
    say(home, "healed")
    home.wait(120, 10)
    home.trouble = ""
    home.wait(3600, 30)
    assert [message.data["type"] for _, message in home.told] == ["digest", "alarm"]
    assert home.told[1][1].data["event"] == "resolved"


def test_a_person_may_resolve_it_and_it_is_told_when_it_comes_back(home: Stand) -> None:
    say(home, "open")
    with home.database.begin() as connection:
        register = AlarmRegister(connection)
        (found,) = register.alarms()
        register.keep(found, lifecycle.resolved(found, "anna", home.clock.wall_ns(), "new fuse"))
    home.wait(2)
    assert home.told[-1][1].data["resolution"] == "new fuse"
    assert "resolved by anna" in home.told[-1][1].body and "new fuse" in home.told[-1][1].body
    say(home, "healed")
    say(home, "open", count=2)
    home.wait(5)
    assert events(home) == ["opened 1", "resolved 1", "opened 1"]


def test_of_two_that_become_one_the_other_is_told_as_over(home: Stand) -> None:
    say(home, "open", "laser")
    say(home, "open", "wheel")
    say(home, "healed", "wheel", reason=f"{FOLLOWS}laser")
    home.wait(2)
    assert events(home) == ["opened 1", "opened 2", "resolved 2"]
    assert home.told[-1][1].data["merged_into"] == 1


def test_what_is_told_to_one_group_goes_on_to_that_group(home: Stand) -> None:
    home.group("ward")
    home.add(["r2"], ["ward"])
    home.connect("r2")
    home.set(NAME, Notifications(webhooks=(hook(groups=("ward",)),)))
    home.lose("r1", "r2")
    home.wait(125, 5)
    home.connect("r1", "r2")
    home.wait(120, 5)
    assert events(home) == ["opened 1", "resolved 1"]
    assert [message.data["robots"] for _, message in home.told] == [["r2"], ["r2"]]


def test_mails_about_an_alarm_are_one_thread() -> None:
    to = Email("technicians", ("anna@example.com",), also=("resolved",))
    with mail_server() as server:
        smtp = Smtp("127.0.0.1", server.port, "none", "fleet@example.com")
        setting = Notifications(smtp, (to,))
        for key in ("k1", "k2"):
            assert (
                deliver(
                    to, NotificationMessage(key, "it", "it", {}, "k1"), setting, 1_800_000_000 * NS
                )
                == ""
            )
    first, second = server.mails
    assert first["In-Reply-To"] is None and first["References"] is None
    assert second["In-Reply-To"] == second["References"] == first["Message-ID"]
    assert second["Message-ID"] != first["Message-ID"]
