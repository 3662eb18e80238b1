"""The people of the tour: a technician who knows only what the pages show, and a colleague.

The technician knows an address and "robot 2 misbehaves".

Only text that is visible is read, and links are found by it. Reading takes as long as it takes
people, and so does pointing at a link.
"""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from amberbox.core.errors import AmberboxError
from amberbox.demo.story import BrowserClient, check, until
from tools.tour.notes import Notes, notes_of

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Locator, Page


WORD_S = 60 / 200  # people read about 200 words a minute
POINT_S = 1.0
_PATIENCE_S = 30.0
_LOOK_S = 0.25
_AGAIN = 2  # how often the answer is read again: it may change meanwhile
# removes the bar that breaks robots: it names the fault
_WITHOUT_BAR = """document.addEventListener("DOMContentLoaded", () => {
    document.getElementById("demo")?.remove()
})"""


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


_SETTLE_S = 240.0  # limit; all is well, and wrong, within seconds unless the machine is very busy
_LEAST_WELL = 15  # components that are well before a fault; the others wait for a first message


@dataclass(frozen=True, slots=True)
class Colleague:
    """Somebody at another browser."""

    browser: BrowserClient

    @classmethod
    def arrived(cls, link: str) -> Colleague:
        """Let somebody sign in by a link."""
        url, _, code = link.partition("/in#")
        browser = BrowserClient(url)
        check(browser.sign_in(code).status == 200, "the link signs in")
        return cls(browser)

    def damage(self, robot: str, fault: str) -> None:
        """Break a robot that is well; return when there is an alarm: it "misbehaves"."""
        until(lambda: self._is_well(robot) or None, lambda: f"{robot} is well", _SETTLE_S)
        self.browser.send("POST", f"/demo/{robot}/fault", {"fault": fault})
        until(lambda: self._card(robot)["alarms"] or None, lambda: "there is an alarm", _SETTLE_S)

    def _is_well(self, robot: str) -> bool:
        card = self._card(robot)
        levels = card["components"]
        return bool(
            card["online"] and levels.get("ok", 0) >= _LEAST_WELL
            and not levels.get("error", 0) and not card["alarms"]
        )  # fmt: skip

    def _card(self, robot: str) -> Any:
        return next(card for card in self.browser.get("/robots") if card["robot"] == robot)
