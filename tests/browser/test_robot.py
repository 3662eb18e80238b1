"""The page of a robot in a browser: it follows the robot, and nothing on it jumps."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING

import pytest
from playwright.sync_api import expect

from amberbox.core.api import Output
from amberbox.server.web import assets, components
from amberbox.server.web.components import key
from amberbox.testing.clock import wait_until
from tests.browser import hostile
from tests.browser.conftest import PageAs
from tests.browser.page_checks import EVERY_LOOK, LOOKS, RESTART, axe, judge, look, shot
from tests.browser.site import Site

if TYPE_CHECKING:
    from playwright.sync_api import Locator, Page, Route, WebSocketRoute

PAGE = "/robots/ropod_001"
SHIFTS = """() => {
    window.shifted = []
    new PerformanceObserver((list) => {
        for (const one of list.getEntries()) {
            if (!one.hadRecentInput) window.shifted.push(one.sources.map((s) => s.node?.className ?? s.node?.nodeName))
        }
    }).observe({type: "layout-shift"})
}"""  # noqa: E501 - it is JavaScript
NUMBERS = (0.0, 0.01, 0.5, 1.0, 9.9996, 24.2, -64.5, 999.96, 5400.0, 123456.7, 2.5e6, 1.5e-5)

EXPECTED: tuple[tuple[str, str, bool | float | str | None], ...] = (
    ("true", "bool", True), ("true", "bool", False), ("!= true", "bool", False),
    (">= 5.0", "float", 5.0), ("< 5.0", "float", 5.0), ("!= 3", "int", 3), ("1 to 3", "int", 4),
    ("1 to 3", "int", 3), ("0.5", "float", 0.5), ("up", "string", "up"), ("up", "float", 1.0),
    ("!= down", "string", "down"), ("1 to 3", "string", "1 to 3"), ("true", "bool", None),
)  # fmt: skip


@pytest.fixture
def robot(site: Site) -> Iterator[Site]:
    """Restore the state of ``ropod_001`` after a test."""
    yield site
    one = site.robots["ropod_001"]
    one.wake()
    one.repeats = True
    site.say("ropod_001", "wifi", "ok")


def is_live(page: Page) -> None:
    expect(page.locator("html")).to_have_attribute("data-feed", "live")


def row(page: Page, component: str, mode: str = "", output: str = "") -> Locator:
    return page.locator(f'#tree [data-k="{key(component, mode, output)}"]')


def test_a_robot_in_trouble(page_as: PageAs) -> None:
    page = page_as("technician")
    page.goto(PAGE)
    is_live(page)
    expect(row(page, "laser_front")).to_have_attribute("aria-expanded", "true")
    expect(row(page, "laser_front").locator(".level")).to_have_text("error")
    explained = page.locator('#diagnosis [data-complete="yes"]')
    expect(explained).to_be_visible()
    judge(page, "robot", EVERY_LOOK)


def test_values_levels_and_reasons_change_where_they_stand(page_as: PageAs, robot: Site) -> None:
    page = page_as("viewer")
    page.goto(f"{PAGE}?open=wifi&open=battery")
    is_live(page)
    page.wait_for_timeout(300)
    page.evaluate(SHIFTS)
    one = robot.robots["ropod_001"]
    one.status("battery", mode="charge", not_empty=False, charge=7.25, time_to_empty=60.0)
    expect(row(page, "battery", "charge", "charge")).to_contain_text("7.250")
    expect(row(page, "battery", "charge", "not_empty")).to_contain_text("no")
    robot.say("ropod_001", "wifi", "stale", reason="nothing heard for 6 s")
    expect(row(page, "wifi").locator(".level")).to_have_text("stale")
    expect(row(page, "wifi")).to_contain_text("nothing heard for 6 s")
    expect(page.locator('[data-count-level="stale"] b')).to_have_text("1")
    assert (
        page.evaluate("() => window.shifted.flat().filter((one) => /td|tr|age|val/.test(one))")
        == []
    )
    robot.say("ropod_001", "wifi", "ok")
    expect(row(page, "wifi").locator(".level")).to_have_text("fine")
    one.status("battery", mode="charge", not_empty=True, charge=64.5, time_to_empty=5400.0)


def test_the_tree_by_keys_alone(page_as: PageAs) -> None:
    page = page_as("viewer")
    page.goto(f"{PAGE}?open=-")
    row(page, "base").focus()
    for pressed, there in (("ArrowDown", "base_controller"), ("End", "wifi"), ("Home", "base"),
                           ("l", "laser_front")):  # fmt: skip
        page.keyboard.press(pressed)
        expect(row(page, there)).to_be_focused()
    page.keyboard.press("ArrowRight")
    expect(row(page, "laser_front")).to_have_attribute("aria-expanded", "true")
    page.keyboard.press("ArrowRight")
    page.keyboard.press("ArrowDown")
    expect(row(page, "laser_front", "heartbeat")).to_be_focused()
    page.keyboard.press("ArrowLeft")
    expect(row(page, "laser_front")).to_be_focused()
    expect(page).to_have_url(re.compile(r"\?open=laser_front$"))
    page.keyboard.press("Enter")
    expect(page).to_have_url(re.compile(r"\?open=-$"))


def test_one_finds_trouble_and_what_is_in_the_way(page_as: PageAs) -> None:
    page = page_as("viewer")
    page.goto(PAGE)
    is_live(page)
    page.get_by_role("button", name="Only trouble").click()
    expect(page.locator(".branch:visible")).to_have_count(4)
    page.get_by_role("searchbox").fill("nothing is called so")
    expect(page.get_by_text("Nothing fits.")).to_be_visible()
    page.get_by_role("link", name="Show all components").click()
    row(page, "navigation").click()
    page.locator(".about:visible [data-blockers] a", has_text="localisation").click()
    expect(row(page, "localisation")).to_be_focused()
    page.locator("#graph svg a", has_text="host").click()
    expect(row(page, "host")).to_have_attribute("aria-expanded", "true")
    page.get_by_role("link", name="6 hours").click()
    expect(page.locator("#timeline")).to_contain_text("6 h ago")
    expect(page).to_have_url(re.compile("window=6h"))


def test_a_silent_robot_is_known_within_three_heartbeats(page_as: PageAs, robot: Site) -> None:
    page = page_as("viewer")
    page.goto(PAGE)
    is_live(page)
    expect(row(page, "base").locator(".age")).to_have_text("1 s")
    robot.robots["ropod_001"].silence()
    expect(page.locator("#silence")).to_contain_text("robot silent since")
    expect(page.locator("#robot-state")).to_contain_text("silent since")
    expect(page.locator("#robot")).to_have_class(re.compile("is-silent"))
    expect(row(page, "base").locator(".age")).to_have_text(re.compile(r"\d\d:\d\d:\d\d"))
    expect(page.locator("#robot-state .level")).to_have_attribute("data-level", "unknown")
    robot.robots["ropod_001"].wake()
    expect(page.locator("#robot")).not_to_have_class(re.compile("is-silent"))
    expect(page.locator("#robot-state")).to_contain_text("online")


def test_a_restart_of_the_server_loses_nothing(page_as: PageAs, site: Site) -> None:
    page = page_as("viewer", expects=RESTART)
    page.goto(f"{PAGE}?open=wifi&open=host")
    is_live(page)
    site.kill()
    expect(page.locator("html")).to_have_attribute("data-feed", "lost")
    expect(page.locator(".lost-banner")).to_be_visible()
    expect(row(page, "base").locator(".age")).to_have_text(re.compile(r"[3-9] s"))
    site.start()
    is_live(page)
    expect(row(page, "wifi")).to_have_attribute("aria-expanded", "true")
    expect(row(page, "laser_front")).to_have_attribute("aria-expanded", "false")
    expect(row(page, "base").locator(".age")).to_have_text(re.compile("[12] s"))


def test_what_was_missed_is_asked_for_behind_a_new_beginning(page_as: PageAs, site: Site) -> None:
    page = page_as("viewer")
    line = Line(page)
    page.goto(PAGE)
    is_live(page)
    line.cut()
    expect(page.locator("html")).to_have_attribute("data-feed", "lost")
    site.robots["ropod_001"].tell("note", "it came while nobody heard")
    wait_until(
        lambda: "while nobody heard" in str(site.ask("/robots/ropod_001/events")), "it is there"
    )
    with page.expect_response(lambda answer: "/diagnosis/card" in answer.url):
        line.mend()
        expect(page.locator("#events")).to_contain_text("while nobody heard")


def test_a_page_says_at_once_when_it_is_not_live(page_as: PageAs) -> None:
    """No timer of the page runs: that the line has ended is enough."""
    page = page_as("viewer")
    page.clock.install()
    line = Line(page)
    page.goto("/")
    is_live(page)
    page.clock.pause_at(page.evaluate("Date.now()") + 1000)
    line.cut()
    expect(page.locator("html")).to_have_attribute("data-feed", "lost")
    expect(page.locator(".when-lost")).to_have_text(re.compile(r"not live since \d\d:\d\d:\d\d"))
    expect(page.locator(".when-live")).to_be_hidden()


COUNTS = """() => {
    const count = document.querySelector(".nav-count");
    count.hidden = false;
    return ["", "warning", "urgent", "critical", "fatal"].map((severity) => {
        count.className = `nav-count${severity && ` severity-${severity}`}`;
        const { color, backgroundColor } = getComputedStyle(count);
        return [color, backgroundColor];
    });
}"""


def _light(colour: str) -> float:
    """Return the relative luminance of a colour as browsers write it (WCAG 2)."""
    parts = [float(number) / 255 for number in re.findall(r"[\d.]+", colour)[:3]]
    red, green, blue = (
        part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in parts
    )
    return 0.2126 * red + 0.7152 * green + 0.0722 * blue


def test_the_number_of_open_alarms_can_be_read_at_any_severity(page_as: PageAs) -> None:
    page = page_as("viewer")
    page.goto("/help")
    for theme, width in LOOKS:
        with look(page, theme, width):
            for ink, ground in page.evaluate(COUNTS):
                low, high = sorted((_light(ink), _light(ground)))
                assert (high + 0.05) / (low + 0.05) >= 4.5, (ink, ground)


class Line:
    """The feed of a page, which can be cut; after a cut the page starts a new one."""

    def __init__(self, page: Page) -> None:
        self._is_cut = False
        self._open: list[WebSocketRoute] = []
        page.route_web_socket(re.compile("/api/v1/feed$"), self._begin)

    def cut(self) -> None:
        self._is_cut = True
        for one in self._open:
            one.close()

    def mend(self) -> None:
        self._is_cut = False

    def _begin(self, line: WebSocketRoute) -> None:
        if self._is_cut:
            line.close()
            return
        self._open.append(line)
        server = line.connect_to_server()
        line.on_message(lambda said: server.send(json.dumps({**json.loads(said), "resume": None})))


def test_tab_leads_into_a_tree_whose_first_row_is_hidden(page_as: PageAs) -> None:
    page = page_as("viewer")
    page.goto(f"{PAGE}?q=wifi")
    is_live(page)
    expect(row(page, "wifi")).to_have_attribute("tabindex", "0")
    page.get_by_role("searchbox").fill("host")
    expect(row(page, "host")).to_have_attribute("tabindex", "0")
    page.locator("#close-all").focus()
    page.keyboard.press("Tab")
    expect(row(page, "host")).to_be_focused()


def test_an_operator_marks_begins_and_ends(page_as: PageAs, site: Site) -> None:
    page = page_as("operator")
    page.goto(PAGE)
    page.get_by_role("button", name="Mark an incident").click()
    page.get_by_label("What happened").fill(hostile.NOTE)
    axe(page, "#dialog-incident")
    page.get_by_role("button", name="Mark", exact=True).click()
    expect(page.get_by_text("The incident is marked.")).to_be_visible()
    assert any(one["reason"] == hostile.NOTE for one in site.ask("/robots/ropod_001/incidents"))
    page.get_by_role("button", name="Begin a mission").click()
    page.get_by_label("Name").fill("round_trip")
    page.get_by_role("button", name="Begin", exact=True).click()
    mission = page.locator("#now .spread", has_text="round_trip")
    expect(mission).to_be_visible()
    mission.get_by_role("button", name="Note").click()
    page.get_by_label("Note", exact=True).fill("the floor is wet")
    page.get_by_role("button", name="Keep").click()
    expect(page.get_by_text("The note is kept.")).to_be_visible()
    mission.get_by_role("button", name="End").click()
    page.get_by_role("button", name="End it").click()
    expect(mission).to_have_count(0)
    (found,) = site.ask("/robots/ropod_001/missions?name=round_trip")
    assert found["to"] and found["notes"][0]["text"] == "the floor is wet"


@pytest.mark.parametrize(("robot", "said"), [("ropod_002", hostile.OUTPUT), ("ropod_003", "")])
def test_odd_names_and_a_robot_that_is_away(page_as: PageAs, robot: str, said: str) -> None:
    page = page_as("viewer", theme="dark")
    page.goto(f"/robots/{robot}")
    is_live(page)
    if said:
        expect(row(page, hostile.COMPONENT, "m", hostile.OUTPUT)).to_contain_text(said)
    else:
        expect(page.get_by_text("Nothing is known of its components yet")).to_be_visible()
    axe(page)
    shot(page, robot)
    assert robot in page.title()


def test_browser_and_server_write_numbers_alike(page_as: PageAs) -> None:
    page = page_as("viewer")
    page.goto(PAGE)
    told = page.evaluate(
        "async ([path, values]) => {"
        " const { numberText } = (await import(path)).$need('robot_values.js');"
        " return values.map(numberText) }",
        [assets.address("all.js"), list(NUMBERS)],
    )
    assert told == [components.number(value) for value in NUMBERS]


def test_browser_and_server_judge_values_alike(page_as: PageAs) -> None:
    page = page_as("viewer")
    page.goto(PAGE)
    told = page.evaluate(
        "async ([path, all]) => {"
        " const { isAsExpected } = (await import(path)).$need('robot_values.js');"
        " return all.map(([expected, value]) => isAsExpected(expected, value)) }",
        [assets.address("all.js"), [[expected, value] for expected, _, value in EXPECTED]],
    )
    outputs = [Output("x", type, value, said, "", "") for said, type, value in EXPECTED]
    assert told == [components.is_met(one) for one in outputs]
    assert any(told) and not all(told)


def test_what_holds_is_folded_and_what_heals_is_said(page_as: PageAs, robot: Site) -> None:
    page = page_as("viewer", width=390)
    page.goto(PAGE)
    is_live(page)
    alive, rate = (row(page, "laser_front", "heartbeat", name) for name in ("alive", "rate_hz"))
    expect(alive).to_contain_text("expected yes")
    expect(rate).to_be_hidden()
    one = robot.robots["ropod_001"]
    before = one.statuses["laser_front", "heartbeat"]
    one.say(replace(before, outputs={"alive": True, "rate_hz": 9.5}))
    expect(alive.get_by_text("so again, counted as failed")).to_be_visible()
    one.say(before)
    expect(alive.get_by_text("so again, counted as failed")).to_be_hidden()
    page.get_by_role("button", name="that hold").click()
    expect(rate).to_be_visible()
    expect(page.locator('[data-component="laser_front"] .about')).to_be_focused()
    box, cause = page.locator("#graph .scroll.live"), page.locator("#graph .node.root")
    place, at = box.bounding_box(), cause.bounding_box()
    assert place and at and place["x"] <= at["x"] <= place["x"] + place["width"]


def test_what_a_battery_measures_comes_without_a_jump(page_as: PageAs, robot: Site) -> None:
    page = page_as("viewer")
    height = "() => document.querySelector('#trend').getBoundingClientRect().height"
    summary = page.locator("#battery-rest summary")
    held: list[Route] = []
    page.route("**/pieces/**/battery", lambda route: held.append(route))
    page.goto(PAGE)
    before = page.evaluate(height)
    while not held:
        page.wait_for_timeout(50)
    held[0].continue_()
    expect(page.locator("#trend")).to_contain_text("Voltage")
    expect(page.locator(".trends li", has_text="Voltage")).to_contain_text(re.compile(r"\d V"))
    assert page.evaluate(height) == before
    expect(summary.locator(":visible")).to_have_text("The one check holds")
    one = robot.robots["ropod_001"]
    was = one.statuses["battery", "charge"]
    one.say(
        replace(was, level="error", state="not_empty", outputs={**was.outputs, "not_empty": False})
    )
    expect(summary.locator(":visible")).to_have_text("The one check does not hold")
    one.say(was)
    expect(summary.locator(":visible")).to_have_text("The one check holds")


def test_files_of_the_folder_come_when_they_are_opened(page_as: PageAs) -> None:
    page = page_as("technician")
    page.goto("/robots/ropod_001")
    files = page.locator("#files")
    expect(files.locator("a")).to_have_count(0)
    files.locator("summary").click()
    expect(files.get_by_role("link", name="robot.yaml")).to_be_visible()
