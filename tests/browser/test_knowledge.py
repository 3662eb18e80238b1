"""The pages of robots' FMEA and rules in a browser."""

import re

from playwright.sync_api import expect

from tests.browser.conftest import PageAs
from tests.browser.page_checks import LOOKS, look, no_sideways_scroll, shot


def test_what_can_fail(page_as: PageAs) -> None:
    page = page_as("technician")
    page.goto("/knowledge")
    page.get_by_role("link", name="Failure modes").first.click()
    expect(page.locator(".sheet tbody tr")).not_to_have_count(0)
    for theme, width in LOOKS:
        with look(page, theme, width):
            no_sideways_scroll(page)  # whom it would stop is asked once, in test_every_page.py
            shot(page, "knowledge", whole=False)


def test_the_sheet_is_looked_through(page_as: PageAs) -> None:
    page = page_as("viewer")
    page.goto("/knowledge/ropod_001")
    rows = page.locator(".sheet tbody tr")
    before = rows.count()
    page.locator('svg a[href*="occurrence="]').first.click()
    expect(page).to_have_url(re.compile("occurrence="))
    assert 0 < rows.count() < before
    page.locator(".chip").click()
    expect(rows).to_have_count(before)
    page.get_by_role("searchbox").fill("laser_front")
    expect(page).to_have_url(re.compile("q=laser_front"))
    assert 0 < rows.count() < before
    expect(page.get_by_role("searchbox")).to_be_focused()
    page.get_by_role("link", name="RPN").click()
    numbers = [int(text) for text in page.locator(".sheet td:nth-child(8)").all_inner_texts()]
    assert numbers == sorted(numbers, reverse=True)


def test_the_sheet_is_taken_along(page_as: PageAs) -> None:
    page = page_as("viewer")
    page.goto("/knowledge/ropod_001")
    with page.expect_download() as taken:
        page.get_by_role("link", name="As CSV").click()
    assert taken.value.suggested_filename == "failure-modes-ropod_001.csv"


def test_what_nothing_sees_is_listed(page_as: PageAs) -> None:
    page = page_as("viewer")
    page.goto("/knowledge/ropod_001?seen=no")
    expect(page.locator(".sheet .level-warn")).to_have_count(
        page.locator(".sheet tbody tr").count()
    )


def test_what_sees_it_is_folded_and_the_head_stays(page_as: PageAs) -> None:
    page = page_as("technician")
    page.goto("/knowledge/ropod_001")
    seen = page.locator(".sheet details").first
    expect(seen.get_by_role("listitem").first).to_be_hidden()
    number = int(seen.locator("summary").inner_text().split()[0])
    seen.locator("summary").click()
    assert seen.get_by_role("listitem").count() == number > 1
    last = page.locator(".sheet tbody tr").last
    last.scroll_into_view_if_needed()
    head = page.locator(".sheet th").first.bounding_box()
    bar = page.locator(".topbar").bounding_box()
    assert head and bar and abs(head["y"] - bar["height"]) <= 2, "the head has gone with the rows"
    action = last.get_by_role("cell").last.bounding_box()
    assert action and action["x"] + action["width"] <= 1440
    page.get_by_role("link", name="Rules", exact=True).click()
    expect(page.get_by_role("heading", name="Rules")).to_be_in_viewport()
