"""Alarms in a browser: looked for, answered one by one and many at once, by mouse and by keys."""

from __future__ import annotations

import json
import re
import time
import urllib.request
from collections.abc import Iterator
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import pytest
from playwright.sync_api import expect
from sqlalchemy import delete

from amberbox.core.clock import NS
from amberbox.server.accounts.sessions import csrf_token
from amberbox.server.alarms.alarm import Alarm
from amberbox.server.http.auth import COOKIE, CSRF_HEADER
from amberbox.server.schema import ALARM, ALARM_ROBOT, HISTORY
from amberbox.testing.clock import PATIENCE_S
from tests.browser import hostile
from tests.browser.conftest import PageAs
from tests.browser.page_checks import EVERY_LOOK, judge, shot
from tests.browser.site import Site

if TYPE_CHECKING:
    from playwright.sync_api import Page

LASER = 4
"""The alarm of the silent laser, which a diagnosis explains."""
GRIPPER, ARM = 901, 902
"""Alarms of these tests alone."""


def put_in(site: Site, number: int, origin: str, severity: Any = "warning") -> None:
    """Insert an alarm of ``ropod_002``, without notifications."""
    now_ns = time.time_ns() - 60 * NS
    alarm = Alarm(number, "robot", "ropod_002", origin, severity, "warn", hostile.MARKUP,
                  now_ns, now_ns)  # fmt: skip
    about = {"alarm": number, "robot": "ropod_002", "from_ns": now_ns, "to_ns": None}
    began = {"alarm": number, "at_ns": now_ns, "who": "", "what": "opened", "text": "odd"}
    with site.database.begin() as connection:
        connection.execute(ALARM.insert(), [asdict(alarm)])
        connection.execute(ALARM_ROBOT.insert(), [about])
        connection.execute(HISTORY.insert(), [began])


@pytest.fixture
def two(site: Site) -> Iterator[None]:
    """Put two open alarms in, for the time of a test."""
    put_in(site, GRIPPER, "gripper", "fatal")
    put_in(site, ARM, "arm")
    yield
    with site.database.begin() as connection:
        for table in (HISTORY, ALARM_ROBOT):
            connection.execute(delete(table).where(table.c.alarm.in_((GRIPPER, ARM))))
        connection.execute(delete(ALARM).where(ALARM.c.number.in_((GRIPPER, ARM))))


def say(site: Site, number: int, deed: str, **body: Any) -> Any:
    """Let another operator do something about an alarm."""
    session = site.session("operator")
    request = urllib.request.Request(
        f"{site.url}/api/v1/alarms/{number}/{deed}", json.dumps(body).encode(),
        {"Cookie": f"{COOKIE}={session}", CSRF_HEADER: csrf_token(session),
         "Content-Type": "application/json"},
    )  # fmt: skip
    with urllib.request.urlopen(request, timeout=PATIENCE_S) as answer:
        return json.load(answer)


def live(page: Page, path: str) -> Page:
    page.goto(path)
    expect(page.locator("html")).to_have_attribute("data-feed", "live")
    return page


def row(page: Page, number: int) -> Any:
    return page.locator(f'.alarm[data-alarm="{number}"]')


def test_how_they_look(page_as: PageAs) -> None:
    page = page_as("operator")
    live(page, "/alarms?state=all")
    row(page, LASER).locator("summary").click()
    expect(row(page, LASER)).to_contain_text("Task executor")
    expect(page).to_have_title(re.compile(r"^\(\d+\) Alarms"))
    judge(page, "alarms", EVERY_LOOK)
    live(page, f"/alarms/{LASER}")
    expect(page.get_by_text("The front laser has no power").first).to_be_visible()
    page.locator("#do-shelve summary").click()
    judge(page, "alarm", EVERY_LOOK)


def test_what_one_looks_for_stands_in_the_address(page_as: PageAs, two: None) -> None:
    page = page_as("viewer")
    page.goto("/alarms")
    page.get_by_role("searchbox").fill("gripper")
    expect(page.locator(".alarm")).to_have_count(1)
    expect(page).to_have_url(re.compile(r"\?q=gripper$"))
    page.get_by_role("link", name=re.compile("^Shelved")).click()
    expect(page.get_by_text("No alarm fits")).to_be_visible()
    page.go_back()
    expect(row(page, GRIPPER)).to_be_visible()
    page.get_by_role("searchbox").fill("")
    page.get_by_label("At least").select_option("fatal")
    expect(row(page, LASER)).to_have_count(0)
    expect(row(page, GRIPPER)).to_contain_text(hostile.MARKUP)
    page.get_by_label("At least").select_option("warning")
    page.get_by_label("When").select_option("own")
    page.get_by_label("To", exact=True).fill("2020-01-01T12:00")
    expect(page.get_by_text("No alarm fits")).to_be_visible()
    expect(page).to_have_url(re.compile(r"to=2020-01-01T11%3A00"))


def test_many_are_acknowledged_at_once_and_others_see_it(
    page_as: PageAs, site: Site, two: None
) -> None:
    page, other = page_as("operator"), live(page_as("viewer"), "/")
    live(page, "/alarms?robot=ropod_002")
    before = int(page.locator("[data-alarm-count]").get_attribute("data-alarm-count") or 0)
    page.get_by_label("Choose all that are open").check()
    expect(page.get_by_text("2 chosen")).to_be_visible()
    page.get_by_placeholder("Note, if you like").fill("on my way")
    page.locator("#bulk").get_by_role("button", name="Acknowledge").click()
    expect(page.get_by_text("2 acknowledged.")).to_be_visible()
    expect(page.locator(".alarm")).to_have_count(0)
    for one in (page, other):
        count = str(before - 2)
        expect(one.locator("[data-alarm-count]")).to_have_attribute("data-alarm-count", count)
    found = site.ask(f"/alarms/{ARM}")
    assert (found["alarm"]["state"], found["history"][-1]["text"]) == ("acknowledged", "on my way")


def test_by_keys_alone(page_as: PageAs, site: Site, two: None) -> None:
    page = page_as("operator")
    live(page, "/alarms?robot=ropod_002")
    page.keyboard.press("j")
    expect(row(page, GRIPPER)).to_be_focused()
    page.keyboard.press("ArrowDown")
    expect(row(page, ARM)).to_be_focused()
    page.keyboard.press("x")
    expect(page.get_by_text("1 chosen")).to_be_visible()
    page.keyboard.press("k")
    page.keyboard.press("a")
    expect(row(page, GRIPPER)).to_have_count(0)
    expect(row(page, ARM)).to_be_focused()
    expect(page.get_by_text("1 chosen")).to_be_visible()
    page.get_by_role("searchbox").focus()
    page.keyboard.type("jaxo")
    expect(page.get_by_text("No alarm fits")).to_be_visible()
    assert site.ask(f"/alarms/{ARM}")["alarm"]["state"] == "open"


def test_from_the_alarm_to_its_diagnosis_and_data_by_keys(page_as: PageAs) -> None:
    page = page_as("viewer")
    live(page, "/alarms?robot=ropod_001")
    page.keyboard.press("j")
    page.keyboard.press("o")
    expect(page).to_have_url(re.compile(f"/alarms/{LASER}$"))
    for name in ("Look at the data", "To the diagnosis"):
        link = page.get_by_role("link", name=name)
        assert "ropod_001" in (link.get_attribute("href") or "")
    for _ in range(40):
        page.keyboard.press("Tab")
        if page.evaluate("document.activeElement.textContent").strip() == "To the diagnosis":
            break
    page.keyboard.press("Enter")
    expect(page).to_have_url(re.compile(r"/robots/ropod_001/diagnosis\?diagnosis=ropod_001-1$"))


def test_what_can_be_done_about_one(page_as: PageAs, site: Site, two: None) -> None:
    page = live(page_as("operator", expects=["400"]), f"/alarms/{GRIPPER}")
    act, history = page.locator("#alarm-act"), page.locator(".alarm-history")
    expect(page.locator("h1")).to_contain_text(hostile.MARKUP)
    act.get_by_label("Note, if you like").fill(hostile.SCRIPT)
    act.get_by_role("button", name="Acknowledge").click()
    expect(history).to_contain_text(hostile.SCRIPT)
    expect(act).to_contain_text("Owner operator")
    act.get_by_role("button", name="Give it back").click()
    expect(act).to_contain_text("Owner nobody")
    act.get_by_role("button", name="Take it").click()
    expect(act).to_contain_text("Owner operator")
    act.locator("#do-shelve summary").click()
    act.get_by_label("another time").check()
    act.get_by_label("That time").fill("2035-01-01T12:00")
    act.get_by_label("Why").first.fill("spare part")
    act.locator("#shelve button").click()
    expect(act.locator("#shelve")).to_contain_text("shelved for a year at most")
    act.get_by_label("tomorrow morning, 7:00").check()
    act.locator("#shelve button").click()
    expect(act.get_by_role("button", name="Unshelve")).to_be_visible()
    until = site.ask(f"/alarms/{GRIPPER}")["alarm"]["shelved"]["until"]
    assert until[11:19] in ("05:00:00", "06:00:00"), "seven in Berlin"
    act.get_by_role("button", name="Unshelve").click()
    act.get_by_text("Add a note").click()
    act.get_by_label("Note", exact=True).fill("it was the fuse")
    act.get_by_role("button", name="Add", exact=True).click()
    expect(history).to_contain_text("it was the fuse")
    act.locator("#do-resolve summary").click()
    act.locator("#resolve").get_by_label("Why").fill("fuse replaced")
    act.locator("#resolve button").click()
    expect(page.locator("#alarm-head")).to_contain_text("resolved by operator")
    expect(act).to_contain_text("It is resolved")


def test_an_operator_gives_it_to_somebody(page_as: PageAs, two: None) -> None:
    page = live(page_as("operator"), f"/alarms/{ARM}")
    page.get_by_label("Give it to").select_option("technician")
    page.get_by_role("button", name="Give", exact=True).click()
    expect(page.locator("#alarm-act")).to_contain_text("Owner technician")


def test_who_was_quicker_is_told_and_nothing_one_wrote_is_lost(
    page_as: PageAs, site: Site, two: None
) -> None:
    page = live(page_as("technician", expects=["409"]), f"/alarms/{GRIPPER}")
    page.locator("#do-resolve summary").click()
    why = page.locator("#resolve").get_by_label("Why")
    why.fill("cable")
    say(site, GRIPPER, "acknowledge", revision=1, note="I have it")
    expect(page.locator("#alarm-news")).to_contain_text("operator changed this alarm")
    expect(page.locator("#alarm-head")).to_contain_text("acknowledged by operator")
    expect(why).to_have_value("cable")
    expect(why).to_be_focused()
    page.locator("#resolve button").click()
    expect(page.locator("#alarm-news")).to_contain_text("Somebody changed this alarm meanwhile")
    expect(why).to_have_value("cable")
    page.locator("#resolve button").click()
    expect(page.locator("#alarm-head")).to_contain_text("resolved by technician")


def test_a_viewer_sees_what_happens_and_changes_nothing(
    page_as: PageAs, site: Site, two: None
) -> None:
    page, robots = live(page_as("viewer"), f"/alarms/{ARM}"), live(page_as("viewer"), "/")
    expect(page.locator("#alarm-act button")).to_have_count(0)
    say(site, ARM, "note", text=hostile.MARKUP)
    expect(page.locator(".alarm-history")).to_contain_text(hostile.MARKUP)
    expect(robots.locator("[data-alarm-count]")).to_be_visible()
    expect(robots).to_have_title(re.compile(r"^\([2-9]\) "))


def test_an_alarm_on_paper(page_as: PageAs) -> None:
    page = page_as("viewer")
    page.goto(f"/alarms/{LASER}")
    page.emulate_media(media="print")
    expect(page.locator("#alarm-act")).to_be_hidden()
    expect(page.locator("h1")).to_be_visible()
    shot(page, "alarm-print")
