"""Checks of a page: errors and failed requests, accessibility, widths; and screenshots of it."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import pytest

if TYPE_CHECKING:
    from playwright.sync_api import ConsoleMessage, Page, Request, Response


RESTART: Sequence[str] = (
    "WebSocket connection to", "ERR_CONNECTION_REFUSED", "ERR_CONNECTION_RESET",
    "ERR_EMPTY_RESPONSE", "ERR_INCOMPLETE_CHUNKED_ENCODING", "ERR_CONTENT_LENGTH_MISMATCH",
)  # fmt: skip
"""Console messages of a page that are expected while its server restarts: give it as
``expects``.
"""
_OWN = ("data:", "blob:", "about:")


@dataclass
class Watched:
    """A page and its troubles, one line each; those with a word of ``expects`` in them are none."""

    page: Page
    url: str
    expects: Sequence[str] = ()
    heard: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.page.on("console", self._console)
        self.page.on("pageerror", lambda error: self.heard.append(f"page error: {error}"))
        self.page.on("request", lambda request: self._left(request.url))
        self.page.on("websocket", lambda socket: self._left(socket.url.replace("ws", "http", 1)))
        self.page.on("response", self._answered)
        self.page.on("requestfailed", self._failed)

    @property
    def troubles(self) -> list[str]:
        """Return what went wrong and was not expected."""
        return [one for one in self.heard if not any(word in one for word in self.expects)]

    def _console(self, message: ConsoleMessage) -> None:
        if message.type == "error":
            where = message.location.get("url", "")
            self.heard.append(f"console: {message.text} ({where})")

    def _left(self, url: str) -> None:
        if not url.startswith((f"{self.url}/", *_OWN)):
            self.heard.append(f"asked another host: {url}")

    def _answered(self, response: Response) -> None:
        if response.status >= 400:
            self.heard.append(f"{response.status} {response.request.method} {response.url}")

    def _failed(self, request: Request) -> None:
        why = request.failure or ""
        if "ERR_ABORTED" not in why:  # who goes to another page lets go of what still comes
            self.heard.append(f"failed: {request.method} {request.url}: {why}")


Look = tuple[Literal["light", "dark"], int]
"""A theme, and the width of a window in pixels."""
LOOKS: Sequence[Look] = (("dark", 390), ("light", 1440))
EVERY_LOOK: Sequence[Look] = (("light", 390), ("dark", 390), ("dark", 1440), ("light", 1440))

NO_AXE = "the package axe-playwright-python is missing: pip install 'amberbox[test]'"
SHOTS = "AMBERBOX_SHOTS"
_GRAVE = ("serious", "critical")
_OPTIONS = {"resultTypes": ["violations"]}
_WIDER = """() => {
    const room = document.documentElement.clientWidth
    const sticksOut = (element) =>
        element.getBoundingClientRect().right > room + 1 && !element.closest(".scroll, pre")
    const named = (element) =>
        [element.tagName.toLowerCase(), element.id, ...element.classList].join(" ")
    const found = [...document.querySelectorAll("body *")].filter(sticksOut).map(named)
    return document.documentElement.scrollWidth > room ? [...found.slice(0, 8), "(page)"] : []
}"""

_SQUEEZED = """() => {
    const whole = (element) => {
        for (const part of [element, ...element.querySelectorAll("*")]) {
            part.style.setProperty("overflow-wrap", "normal", "important")
            part.style.setProperty("word-break", "normal", "important")
        }
        return element.scrollWidth > element.clientWidth + 1
    }
    const hasRoomBeside = (dd) => dd.clientWidth < 0.9 * dd.closest("dl").clientWidth
    const found = [...document.querySelectorAll("dd")].filter((dd) => dd.checkVisibility())
    return found.filter(hasRoomBeside).filter(whole).map((dd) => dd.textContent.trim())
}"""


def axe(page: Page, within: str | None = None) -> None:
    """Fail where people with impairments would be stopped (impact serious or critical)."""
    found = pytest.importorskip("axe_playwright_python.sync_playwright", reason=NO_AXE)
    violations = found.Axe().run(page, within, _OPTIONS).response["violations"]
    grave = [_in_words(one) for one in violations if one["impact"] in _GRAVE]
    assert not grave, "\n".join([page.url, *grave])


def _in_words(violation: dict[str, Any]) -> str:
    nodes = [
        f"    {' '.join(map(str, node['target']))}: {node.get('failureSummary', '')!r}"
        for node in violation["nodes"][:5]
    ]
    head = f"{violation['impact']}: {violation['id']}: {violation['help']}"
    return "\n".join([f"{head} ({len(violation['nodes'])} places)", *nodes])


def no_sideways_scroll(page: Page) -> None:
    """Fail when the page is wider than its window; tables scroll in a ``.scroll`` of their own."""
    assert page.evaluate(_WIDER) == [], f"{page.url} is wider than its window"


def no_squeezed_values(page: Page) -> None:
    """Fail when a value of a list is narrower than its longest word while its key takes room."""
    assert page.evaluate(_SQUEEZED) == [], f"{page.url} has values broken within words"


def shot(page: Page, name: str, *, whole: bool = True) -> None:
    """Write ``<name>-<width>-<theme>.png`` to the folder $AMBERBOX_SHOTS, if one is named."""
    if not os.environ.get(SHOTS):
        return
    folder = Path(os.environ[SHOTS])
    folder.mkdir(parents=True, exist_ok=True)
    dark = page.evaluate("() => matchMedia('(prefers-color-scheme: dark)').matches")
    width = page.viewport_size["width"] if page.viewport_size else 0
    path = folder / f"{name}-{width}-{'dark' if dark else 'light'}.png"
    page.screenshot(path=path, full_page=whole)


_WEAR = """(theme) => {
    document.cookie = `theme=${theme}; path=/`
    document.documentElement.dataset.theme = theme
}"""


@contextmanager
def look(page: Page, theme: Literal["light", "dark"], width: int) -> Iterator[None]:
    """Give an open page a theme and a width; what fails in the block is told with both."""
    height = page.viewport_size["height"] if page.viewport_size else 900
    page.set_viewport_size({"width": width, "height": height})
    page.emulate_media(color_scheme=theme)
    page.evaluate(_WEAR, theme)
    try:
        yield
    except AssertionError as error:
        error.add_note(f"in the {theme} theme, {width} px wide")
        raise


def judge(
    page: Page, name: str, looks: Sequence[Look] = LOOKS, *,
    within: Sequence[str | None] = (None,), whole: bool = True,
) -> None:  # fmt: skip
    """Fail when a page, as it stands, stops somebody or is too wide in one of the looks."""
    for theme, width in looks:
        with look(page, theme, width):
            no_sideways_scroll(page)
            for part in within:
                axe(page, part)
            shot(page, name, whole=whole)
