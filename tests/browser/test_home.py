"""The first page in a browser: the present state of all robots."""

import re

from playwright.sync_api import expect

from tests.browser.conftest import PageAs
from tests.browser.page_checks import EVERY_LOOK, judge
from tests.browser.site import Site


def test_robots_at_a_glance(page_as: PageAs, site: Site) -> None:
    page = page_as("viewer")
    page.goto("/")
    expect(page.locator(".robot-card")).to_have_count(len(site.ask("/robots", "viewer")))
    judge(page, "home", EVERY_LOOK)


def test_a_card_follows_its_robot(page_as: PageAs, site: Site) -> None:
    page = page_as("viewer")
    page.goto("/")
    card = page.locator('[data-robot="ropod_002"]')
    expect(page.locator("html")).to_have_attribute("data-feed", "live")
    site.say("ropod_002", "wifi", "error", reason="no network")
    expect(card).to_contain_text("Wifi: no network")
    expect(card).to_have_attribute("data-level", "error")
    site.say("ropod_002", "wifi", "ok")
    expect(card).not_to_contain_text("no network")


def test_one_finds_the_robot_one_looks_for(page_as: PageAs, site: Site) -> None:
    page = page_as("viewer")
    page.goto("/")
    page.get_by_role("searchbox").fill("002")
    expect(page.locator(".robot-card")).to_have_count(1)
    expect(page).to_have_url(re.compile(r"\?q=002$"))
    page.get_by_role("searchbox").fill("no such robot")
    expect(page.get_by_text("No robot fits")).to_be_visible()
    page.get_by_role("searchbox").fill("")
    page.get_by_role("button", name="Offline").click()
    expect(page.get_by_role("button", name="Offline")).to_have_attribute("aria-pressed", "true")
    page.go_back()
    expect(page.get_by_role("button", name="All")).to_have_attribute("aria-pressed", "true")
    expect(page.locator(".robot-card")).to_have_count(len(site.ask("/robots", "viewer")))


def test_robots_by_team_and_by_name(page_as: PageAs) -> None:
    page = page_as("viewer")
    page.goto("/?by=team&sort=name")
    expect(page.locator("h2 .muted")).not_to_have_count(0)
    names = page.locator(".robot-card h3").all_inner_texts()
    assert len(names) >= 3
    page.get_by_role("checkbox").uncheck()
    expect(page.locator("h2 .muted")).to_have_count(0)
    assert page.locator(".robot-card h3").all_inner_texts() == sorted(set(names))


def test_a_card_holds_what_it_says(page_as: PageAs) -> None:
    page = page_as("viewer", width=1440)
    page.goto("/")
    for card in page.locator(".robot-card").all():
        inside = card.evaluate(
            "one => [...one.querySelectorAll('.facts, .cause, .cause ~ *')].map(part =>"
            " [part.scrollWidth - part.clientWidth, part.getBoundingClientRect().right])"
        )
        edge = card.evaluate("one => one.getBoundingClientRect().right")
        assert all(over <= 1 and right <= edge for over, right in inside), inside


def test_a_wall_screen_is_used(page_as: PageAs) -> None:
    page = page_as("viewer", width=3840, height=2160)
    page.goto("/")
    brand = page.locator(".brand").bounding_box()
    card = page.locator(".robot-card").last.bounding_box()
    title = page.get_by_role("heading", name="Robots", exact=True).bounding_box()
    assert brand and card and title and abs(brand["x"] - title["x"]) <= 4
    assert card["x"] + card["width"] > 2 / 3 * 3840
    assert page.evaluate("parseFloat(getComputedStyle(document.documentElement).fontSize)") >= 20


def test_all_pages_can_be_reached_on_a_phone(page_as: PageAs) -> None:
    page = page_as("admin", width=390)
    page.goto("/")
    for link in page.locator(".nav a").all():
        box = link.bounding_box()
        assert box and box["x"] >= 0 and box["x"] + box["width"] <= 390 and box["height"] >= 44
