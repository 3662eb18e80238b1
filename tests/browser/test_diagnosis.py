"""The page of a diagnosis in a browser: answering a test, opening details, entering the cause."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING

import pytest
from playwright.sync_api import expect

from amberbox.core.types import Symptom
from amberbox.diagnosis.diagnose import DiagnosisId, ObservedSituation, answer
from amberbox.testing.clock import wait_until
from tests.browser.conftest import PageAs
from tests.browser.page_checks import axe, judge, no_sideways_scroll, shot
from tests.browser.site import HASH_2, Site
from tests.server.knowledge.robot import knowledge

if TYPE_CHECKING:
    from playwright.sync_api import Page

BASE = "/robots/ropod_001/diagnosis"
ROBOT = "ropod_002"
NO_SCANS = "laser_front/heartbeat/alive"


@pytest.fixture
def broken(site: Site, request: pytest.FixtureRequest) -> Iterator[str]:
    """Let the front laser of a robot fall silent; give the page of it. Mended afterwards."""
    robot = site.robots[ROBOT]
    at_ns = robot.clock.wall_ns()
    silent = Symptom(NO_SCANS, "present", NO_SCANS, at_ns, at_ns,
                     evidence=(("sim_scan_front", at_ns, at_ns),))  # fmt: skip
    heading = DiagnosisId(f"{ROBOT}-{request.node.name[:24]}", 1, at_ns)
    found = answer(knowledge(ROBOT, HASH_2), ObservedSituation((silent,), watched=True), heading)
    robot.say(silent, found)
    diagnoses = f"/robots/{ROBOT}/diagnoses"
    wait_until(lambda: site.ask(diagnoses)[0]["id"] == found.id, "the server knows it")
    yield f"/robots/{ROBOT}/diagnosis"
    then_ns = robot.clock.wall_ns()
    gone = Symptom(NO_SCANS, "absent", NO_SCANS, None, then_ns)
    robot.say(gone, replace(found, revision=2, state="healed", at_ns=then_ns))


HEATS, HOT, JUMPS = (
    "battery.heats", "battery/temperature/in_range", "localisation/position/does_not_jump",
)  # fmt: skip


@pytest.fixture
def hot(site: Site) -> Iterator[str]:
    """Let a robot's battery overheat, an older fault being mended; give the page of it."""
    robot, ns = site.robots[ROBOT], 1_000_000_000
    at_ns = robot.clock.wall_ns()
    lost = Symptom(JUMPS, "present", JUMPS, at_ns - 120 * ns, at_ns - 120 * ns)
    rate = "the rate of temperature over 40 s is 0.034, at most 0.01"
    heats = Symptom(HEATS, "present", HEATS, at_ns - 5 * ns, at_ns - 5 * ns, reason=rate)
    warm = Symptom(HOT, "present", HOT, at_ns, at_ns, reason="temperature is 58.2 °C, at most 50")
    heading = DiagnosisId(f"{ROBOT}-hot", 1, at_ns)
    found = answer(
        knowledge(ROBOT, HASH_2), ObservedSituation((lost, heats, warm), watched=True), heading
    )
    gone = Symptom(JUMPS, "absent", JUMPS, None, at_ns - 30 * ns)
    robot.say(lost, gone, heats, warm, found)
    yield f"/robots/{ROBOT}/diagnosis"
    then_ns = robot.clock.wall_ns()
    over = [Symptom(name, "absent", name, None, then_ns) for name in (HEATS, HOT)]
    robot.say(*over, replace(found, revision=2, state="healed", at_ns=then_ns))


def opened(page: Page, path: str) -> Page:
    page.goto(path)
    page.locator("#dx-card [data-complete=yes]").wait_for()
    return page


def test_the_card(page_as: PageAs) -> None:
    page = opened(page_as("viewer"), BASE)
    expect(page.get_by_text("The front laser has no power", exact=True)).to_be_visible()
    expect(page.get_by_text("No, it cannot go on with what it does.")).to_be_visible()
    expect(page.get_by_role("button", name="Yes", exact=True)).to_have_count(0)
    judge(page, "diagnosis")


def test_what_is_dangerous_is_told_first_on_a_phone(page_as: PageAs, hot: str) -> None:
    page = opened(page_as("operator", 390, height=844), hot)
    card = page.locator("#dx-card")
    safe = card.locator(".dx-safe")
    expect(safe).to_contain_text("Switch off, let it cool outside.")
    expect(card.locator(".dx > .dx-cause")).to_have_text("The battery heats itself")
    expect(card.locator(".dx-cleared")).to_contain_text("Localisation has settled on a wrong place")
    reason = card.locator(".dx-why li").first
    expect(reason).to_contain_text("temperature over 40 s is 0.034, at most 0.01")
    expect(card.locator(".dx-why")).to_contain_text("temperature is 58.2 °C, at most 50")
    tops = [page.evaluate("e => e.getBoundingClientRect().top", one.element_handle())
            for one in (card.locator(".dx > .dx-cause"), safe, reason)]  # fmt: skip
    box = reason.bounding_box()
    assert box is not None and tops == sorted(tops)
    assert box["y"] + box["height"] <= 844, "the first screenful has all three"
    judge(page, "hot", [("light", 390), ("dark", 390)])


def test_a_test_is_answered_and_the_cause_is_said(page_as: PageAs, broken: str) -> None:
    page = opened(page_as("operator"), broken)
    page.evaluate("window.sameAsBefore = true")
    page.get_by_role("button", name="No", exact=True).click()
    expect(page.locator("#dx-card .dx-cause")).to_have_count(1)
    expect(page.locator("#dx-card .dx-cause")).to_have_text("The front laser has no power")
    expect(page.locator(".dx-title")).to_be_focused()
    page.get_by_text("Details", exact=True).click()
    page.get_by_role("tab", name="What it was").click()
    page.get_by_label("Note").fill("the plug was loose")
    page.get_by_role("button", name="Keep it").click()
    expect(page.get_by_text("It was this, says operator")).to_be_visible()
    expect(page.locator("#dx-tab")).to_contain_text("the plug was loose")
    assert "tab=cause" in page.url and "details=1" in page.url
    assert page.evaluate("window.sameAsBefore")
    axe(page)
    shot(page, "diagnosis-cause")


def test_what_happens_is_shown_as_it_happens(page_as: PageAs, site: Site, broken: str) -> None:
    page = opened(page_as("operator", 390, "dark"), broken)
    page.evaluate("window.sameAsBefore = true")
    other = opened(page_as("technician"), broken)
    other.get_by_role("button", name="Yes", exact=True).click()
    expect(page.locator("#dx-card .dx-cause")).to_have_count(1)
    assert page.evaluate("window.sameAsBefore")
    no_sideways_scroll(page)


def test_details_stand_in_the_address(page_as: PageAs) -> None:
    page = opened(page_as("operator"), BASE)
    page.get_by_text("Details", exact=True).click()
    expect(page.get_by_text("Speaks for it").first).to_be_visible()
    for name, sign in (("Causes and effects", "svg.effects"), ("Fault tree", "svg.faulttree"),
                       ("History", "table")):  # fmt: skip
        page.get_by_role("tab", name=name).click()
        expect(page.locator(f"#dx-tab {sign}").first).to_be_visible()
        axe(page)
        shot(page, f"diagnosis-{name.split()[-1].lower()}")
    again = opened(page_as("viewer", 390, "dark"), page.url)
    expect(again.locator("#dx-tab table").first).to_be_visible()
    no_sideways_scroll(again)
    axe(again)


def test_what_if_and_back(page_as: PageAs) -> None:
    page = opened(page_as("operator"), f"{BASE}?details=1&tab=whatif")
    page.get_by_label("Another symptom").fill("laser_rear/heartbeat/alive")
    page.get_by_role("button", name="Work it out").click()
    expect(page.get_by_text("The answer would be")).to_be_visible()
    expect(page.locator("#dx-tab .dx")).to_contain_text("rear laser")
    assert "present=laser_rear" in page.url
    axe(page)
    shot(page, "diagnosis-whatif")
    page.go_back()
    expect(page.get_by_text("The answer as it is")).to_be_visible()


def test_rules_are_asked_with_keys_alone(page_as: PageAs) -> None:
    page = opened(page_as("operator"), f"{BASE}?details=1")
    page.get_by_role("tab", name="Candidates").focus()
    for _ in range(4):
        page.keyboard.press("ArrowRight")
    expect(page.get_by_role("tab", name="Rules")).to_be_focused()
    expect(page.get_by_label("Goal")).to_be_visible()
    page.get_by_label("Goal").focus()
    page.keyboard.type("in_error(C)")
    page.keyboard.press("Enter")
    expect(page.locator("#dx-tab tbody")).to_contain_text("laser_front")
    axe(page)
    page.get_by_label("Goal").fill("in_error(")
    page.keyboard.press("Enter")
    expect(page.locator("#dx-tab .problem")).to_be_visible()
    expect(page.get_by_label("Goal")).to_have_value("in_error(")


def test_any_moment(page_as: PageAs) -> None:
    page = page_as("viewer")
    page.goto(f"{BASE}?at=-50m&details=1&tab=effects")
    expect(page.locator("#dx-card")).to_contain_text("Nothing is known to be broken")
    expect(page.locator("#dx-tab .empty")).to_be_visible()
    page.get_by_role("link", name="Back to now").click()
    expect(page.locator("#dx-card .dx-cause")).to_be_visible()


def test_words_are_found(page_as: PageAs) -> None:
    page = page_as("viewer", 390)
    page.goto("/help")
    page.get_by_label("Find a word").fill("shelved")
    expect(page.locator(".word-entry:visible")).to_have_count(1)
    axe(page)
    no_sideways_scroll(page)
    page.goto("/help#cut_set")
    expect(page.locator("#cut_set")).to_be_visible()
