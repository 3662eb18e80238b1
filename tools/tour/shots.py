"""Takes the pictures of docs/tour.md: the same way once more, with nothing measured."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

from tools.tour.stage import Demonstration
from tools.tour.technician import answer_of, opened, robot_card

if TYPE_CHECKING:
    from playwright.sync_api import Browser, FloatRect, Page

_SETTLE_MS = 2500
"""So long a page is left alone before it is looked at: plots and values have come by then."""
_WHO = "technician"


def take(browser: Browser, demo: Demonstration, number: int, folder: Path) -> None:
    """Write the pictures to a folder: a robot is broken now."""
    folder.mkdir(parents=True, exist_ok=True)
    with opened(browser, demo.links()[_WHO]) as page:
        _walk(page, number, folder)
    with opened(browser, demo.links()[_WHO], theme="dark") as page:
        _to_answer(page, number)
        _shot(page, folder, "diagnosis-dark")
    with opened(browser, demo.links()[_WHO], width=390, height=844) as page:
        _to_answer(page, number)
        _shot(page, folder, "diagnosis-narrow", height=1100)


def _walk(page: Page, number: int, folder: Path) -> None:
    """Go from the list to the answer, to the data that it rests on, to robot and alarm."""
    _shot(page, folder, "robots", height=420)
    _to_answer(page, number)
    _shot(page, folder, "diagnosis")
    reason = page.get_by_role("main").get_by_title("The data of that moment").first
    reason.click()
    page.wait_for_url("**/data?*")
    _shot(page, folder, "data")
    page.get_by_role("link", name="Status", exact=True).click()
    page.get_by_role("treegrid").first.wait_for()
    _shot(page, folder, "robot", height=500)
    page.get_by_role("main").get_by_role("link", name=re.compile("open alarm")).first.click()
    page.get_by_role("heading", name="Alarms").wait_for()
    _shot(page, folder, "alarms")


def _to_answer(page: Page, number: int) -> None:
    robot_card(page, number).get_by_role("link", name="What is broken?").click()
    answer_of(page)


def _shot(page: Page, folder: Path, name: str, height: int = 0) -> None:
    """Take a picture of the upper part of the page."""
    page.wait_for_timeout(_SETTLE_MS)
    size = page.viewport_size
    assert size is not None, "the window has a size"
    clip: FloatRect = {"x": 0, "y": 0, "width": size["width"], "height": height or size["height"]}
    path = folder / f"{name}.png"
    page.screenshot(path=path, clip=clip, full_page=True)
    print(f"{path}: {path.stat().st_size:,} bytes", flush=True)
