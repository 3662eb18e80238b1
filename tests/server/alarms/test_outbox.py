"""The outbox: once per alarm, digests, quiet hours, groups; nothing lost, nothing twice."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from amberbox.server.alarms.alarm import AlarmSettings
from amberbox.server.alarms.recipients import NAME, Email, Notifications, Quiet, Smtp, Webhook
from tests.server.alarms.stand import Stand, alarm, stand

SECRET = "0123456789abcdef"
HOOK = "https://hook.example/"


@pytest.fixture
def home(tmp_path: Path) -> Iterator[Stand]:
    with stand(tmp_path) as one:
        one.set("alarms", AlarmSettings(settle_s=0))
        one.alarms.step()
        yield one


def open_some(home: Stand, count: int, first: int = 0, **more: str) -> None:
    for number in range(first, first + count):
        home.hear("r1", alarm(home, f"c{number}", **more))  # type: ignore[arg-type] # severity
        home.wait(1)


def test_more_than_5_in_10_minutes_come_as_a_digest(home: Stand) -> None:
    open_some(home, 20)
    assert len(home.told) == 5
    home.wait(70, 5)
    assert len(home.told) == 6
    name, digest = home.told[-1]
    assert (name, digest.subject) == ("hook", "15 alarms, up to urgent")
    assert [one["id"] for one in digest.data["alarms"]] == list(range(6, 21))
    assert digest.body.count("urgent: r1 c") == 15
    open_some(home, 5, first=20)
    home.wait(300, 10)
    assert len(home.told) == 6, "one digest in 10 minutes"
    home.wait(300, 10)
    assert home.told[-1][1].subject == "5 alarms, up to urgent"
    home.wait(600, 30)
    open_some(home, 1, first=30)
    assert len(home.told) == 8


def test_what_could_not_be_delivered_is_tried_again_and_shown(home: Stand) -> None:
    home.trouble = "the answer was 503"
    open_some(home, 2)
    assert home.told == []
    assert [(row["state"], row["tries"] > 0, row["trouble"]) for row in home.outbox()] == [
        ("waiting", True, "the answer was 503")
    ] * 2
    home.wait(20)
    home.trouble = ""
    home.restart()
    home.connect("r1")
    home.wait(3600, 60)
    assert [message.data["id"] for _, message in home.told] == [1, 2]
    assert {row["state"] for row in home.outbox()} == {"sent"}


def test_after_many_attempts_it_has_failed(home: Stand) -> None:
    home.trouble = "nobody there"
    open_some(home, 1)
    home.wait(24 * 3600, 900)
    (row,) = home.outbox()
    assert (row["state"], row["tries"], row["trouble"]) == ("failed", 12, "nobody there")


def test_a_restart_neither_loses_nor_doubles(home: Stand) -> None:
    home.hear("r1", alarm(home))
    home.alarms.step()  # it is in the outbox, and not sent
    assert [row["state"] for row in home.outbox()] == ["waiting"]
    for _ in range(3):
        home.restart()
        home.wait(5)
    assert len(home.told) == 1


@pytest.mark.parametrize("settle_s", [0, 10])
def test_a_clock_that_was_a_year_ahead_holds_nothing_up(home: Stand, settle_s: int) -> None:
    home.set("alarms", AlarmSettings(settle_s=settle_s))
    home.clock.step(366 * 86_400)
    home.trouble = "nobody there"
    home.hear("r1", alarm(home))
    home.alarms.step()
    home.alarms.sender.step()
    home.clock.step(-366 * 86_400)
    home.trouble = ""
    home.wait(settle_s + 5)
    assert len(home.told) == 1


def test_who_is_not_in_the_settings_any_more_gets_nothing(home: Stand) -> None:
    home.hear("r1", alarm(home))
    home.alarms.step()
    home.set(NAME, Notifications())
    home.wait(5)
    assert home.told == []
    assert home.outbox()[0]["state"] == "failed"


def test_severity_and_groups_decide_who_is_told(home: Stand) -> None:
    home.group("ward")
    home.add(["r2"], ["ward"])
    home.connect("r2")
    smtp = Smtp("mail.example", sender="fleet@example.com")
    home.set(NAME, Notifications(
        smtp, (Email("night", ("anna@example.com",), "critical"),),
        (Webhook("ward", HOOK, SECRET, groups=("ward",)), Webhook("all", HOOK, SECRET)),
    ))  # fmt: skip
    home.hear("r1", alarm(home))
    home.wait(1)
    assert [name for name, _ in home.told] == ["all"]
    home.hear("r2", alarm(home, severity="fatal"))
    home.wait(1)
    assert sorted(name for name, _ in home.told[1:]) == ["all", "night", "ward"]


def test_of_several_robots_a_group_hears_of_its_own(home: Stand) -> None:
    home.group("ward")
    home.add(["r2"], ["ward"])
    home.connect("r2")
    home.set(NAME, Notifications(webhooks=(Webhook("ward", HOOK, SECRET, groups=("ward",)),)))
    home.lose("r1", "r2")
    home.wait(125, 5)
    ((_, message),) = home.told
    assert message.data["robots"] == ["r2"]


def test_in_quiet_hours_only_the_worst_is_told_and_the_rest_after(home: Stand) -> None:
    quiet = Quiet("07:00", "09:00", but="fatal")  # the stand begins at 08:00
    home.set(NAME, Notifications(webhooks=(Webhook("hook", HOOK, SECRET, quiet=quiet),)))
    open_some(home, 2)
    assert home.told == []
    open_some(home, 1, first=2, severity="fatal")
    assert [message.subject for _, message in home.told] == ["fatal: r1 c2"]
    home.wait(3600, 60)
    assert [message.subject for _, message in home.told[1:]] == ["2 alarms, up to urgent"]


def test_shelved_it_is_told_when_it_leaves_the_shelf_and_lasts(home: Stand) -> None:
    from amberbox.core.clock import NS
    from amberbox.server.alarms import lifecycle
    from amberbox.server.alarms.store import AlarmRegister

    home.set("alarms", AlarmSettings())
    home.hear("r1", alarm(home))
    home.alarms.step()
    one = home.only()
    until_ns = home.clock.wall_ns() + 100 * NS
    with home.database.begin() as connection:
        step = lifecycle.shelved(one, "anna", home.clock.wall_ns(), until_ns, "known")
        AlarmRegister(connection).keep(one, step)
    home.wait(99, 5)
    assert home.told == []
    home.wait(5)
    assert len(home.told) == 1 and home.only().state == "open"


def test_one_destination_that_fails_holds_up_no_other(home: Stand) -> None:
    home.set(NAME, Notifications(webhooks=(
        Webhook("bad", HOOK, SECRET), Webhook("good", HOOK, SECRET),
    )))  # fmt: skip
    sent = []

    def deliver(to: object, message: object, *_: object) -> str:
        sent.append(to)
        return "nobody there" if getattr(to, "name", "") == "bad" else ""

    home.alarms.sender.deliver = deliver
    open_some(home, 3)
    states = {(row["destination"], row["state"]) for row in home.outbox()}
    assert states == {("bad", "waiting"), ("good", "sent")}
