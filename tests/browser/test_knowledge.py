"""What robots know, in a browser."""

import re

import pytest

from tests.browser.conftest import PageAs
from tests.browser.expecting import expect
from tests.browser.looks import axe, no_sideways_scroll, shot


@pytest.mark.parametrize(("theme", "width"), [("light", 1440), ("dark", 390)])
def test_what_can_fail(page_as: PageAs, theme: str, width: int) -> None:
    page = page_as("technician", width=width, theme=theme)
    page.goto("/knowledge")
    page.get_by_role("link", name="Failure modes").first.click()
    expect(page.locator(".sheet tbody tr")).not_to_have_count(0)
    axe(page)
    no_sideways_scroll(page)
    shot(page, f"knowledge-{theme}-{width}")


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
