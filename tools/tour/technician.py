"""Somebody who knows an address and "robot 2 misbehaves", and nothing but what the pages show.

Only text that is visible is read, and links are found by it. Reading takes as long as it takes
people, and so does pointing at a link.
"""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from amberbox.core.errors import AmberboxError
from tools.tour.notes import Notes, notes_of

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Locator, Page

WORD_S = 60 / 200
"""People read about 200 words a minute."""
POINT_S = 1.0
_PATIENCE_S = 30.0
_LOOK_S = 0.25
_AGAIN = 2
"""So often the answer is looked at again: it may become another one meanwhile."""
_WITHOUT_BAR = """document.addEventListener("DOMContentLoaded", () => {
    document.getElementById("demo")?.remove()
})"""
"""The bar that breaks robots tells what is broken: whoever is to find that out must not see it."""


@contextmanager
def opened(
    browser: Browser, link: str, *, width: int = 1200, height: int = 750, theme: str = "light"
) -> Iterator[Page]:
    """Open a link that signs in, in a browser of its own that has seen nothing before."""
    context = browser.new_context(
        viewport={"width": width, "height": height}, locale="en-GB", timezone_id="UTC",
        color_scheme="dark" if theme == "dark" else "light", reduced_motion="reduce",
    )  # fmt: skip
    context.set_default_timeout(_PATIENCE_S * 1e3)
    context.add_init_script(_WITHOUT_BAR)
    page = context.new_page()
    try:
        page.goto(link)
        page.get_by_role("heading", name="Robots", exact=True).wait_for()
        yield page
    finally:
        context.close()


def find_out(page: Page, number: int) -> Notes:
    """Go from the list of the robots to what is wrong with one of them; write that down."""
    card = robot_card(page, number)
    _read(card.inner_text())
    answer = card.get_by_role("link", name="What is broken?")
    press(answer if answer.is_visible() else card.get_by_role("link").first)
    return _written_down(page)


def robot_card(page: Page, number: int) -> Locator:
    """Return the card of a robot that people call by a number."""
    heading = page.get_by_role("heading", name=re.compile(rf"(?<!\d)0*{number}$"))
    return page.get_by_role("article").filter(has=heading)


def press(link: Locator) -> None:
    """Point at a link and press it."""
    time.sleep(POINT_S)
    link.click()


def answer_of(page: Page) -> Notes:
    """Wait until the answer is on the page."""
    main = page.get_by_role("main")
    end_s = time.monotonic() + _PATIENCE_S
    while True:
        try:
            return notes_of(main.inner_text())
        except ValueError as error:
            if time.monotonic() > end_s:
                raise AmberboxError(f"{error}; it says: {main.inner_text()}") from error
        time.sleep(_LOOK_S)


def _written_down(page: Page) -> Notes:
    """Read the answer; where it became another one meanwhile, what is new in it as well."""
    notes = answer_of(page)
    _read(str(notes))
    for _ in range(_AGAIN):
        newer = answer_of(page)
        _read(str(newer), str(notes))
        notes = newer
    return notes


def _read(text: str, known: str = "") -> None:
    """Read a text for as long as people do, without the lines that are known."""
    before = set(known.splitlines())
    new = [line for line in text.splitlines() if line not in before]
    time.sleep(WORD_S * sum(len(line.split()) for line in new))
