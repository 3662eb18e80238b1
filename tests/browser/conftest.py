"""One real server and one real browser for all tests of pages.

A test of a page::

    import pytest
    from tests.browser.conftest import PageAs
    from tests.browser.page_checks import axe, no_sideways_scroll, shot
    from tests.browser.site import Site

    @pytest.mark.parametrize("theme", ["light", "dark"])
    def test_the_fleet(page_as: PageAs, site: Site, theme: str) -> None:
        page = page_as("viewer", width=390, theme=theme)
        page.goto("/")                                   # paths are those of the site
        page.get_by_role("link", name="ropod_001").wait_for()
        site.say("ropod_002", "wifi", "error", reason="no network")   # comes over the link
        page.get_by_text("Wifi: no network").wait_for()  # and over the feed
        axe(page), no_sideways_scroll(page), shot(page, "fleet")

At the end of a test each of its pages is closed, and the test fails when one had an error on its
console, an error in a script, an answer of 400 or more, or asked anybody but the site. What is
meant to happen is named by a word of its line: ``page_as("viewer", expects=["404 GET"])``; while
the server is restarted ``expects=RESTART`` (``tests/browser/page_checks.py``).

- ``site`` (site.py): ``url``, ``restart()``, ``ask("/robots")``, ``session(name)``; ``site.robots``
  are the robots (robot.py) that one lets find something: ``change``, ``status``, ``say``,
  ``tell`` (an event), ``measure`` (live values), and who ``silence()``, ``wake()``, ``leave()``
  and ``come()``. What a test changes it puts right again: all tests share one site.
  What was recorded and said stands in record.py and story.py, hostile names in hostile.py.
- People: viewer, operator, technician, admin, and nurse, a technician for the ward only.
- ``expect`` of Playwright waits as long as everything else does: ``browser`` sets that.
- Screenshots go to the folder $AMBERBOX_SHOTS.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

import pytest

from amberbox.server.http.auth import COOKIE
from tests.browser.chromium import chromium, only
from tests.browser.page_checks import Watched
from tests.browser.site import Site, made

if TYPE_CHECKING:
    from playwright.sync_api import Browser, BrowserContext, Page

_HERE = Path(__file__).parent
_WAIT_MS = 60_000
_OPEN: pytest.StashKey[ExitStack] = pytest.StashKey()


class PageAs(Protocol):
    """Opens pages as a person, or signed out without a name; ``at`` is another server's address."""

    watched: list[Watched]

    def __call__(
        self, name: str = "", width: int = 1440, theme: str = "light", *, height: int = 900,
        expects: Sequence[str] = (), at: str = "", **options: object,
    ) -> Page: ...  # fmt: skip


@pytest.hookimpl(wrapper=True)
def pytest_runtest_teardown(
    item: pytest.Item, nextitem: pytest.Item | None
) -> Generator[None, None, None]:
    """End browser and server after the last test of pages: Playwright's loop would block others."""
    yield
    if nextitem is None or _HERE not in nextitem.path.parents:
        item.config.stash.setdefault(_OPEN, ExitStack()).close()


def pytest_sessionfinish(session: pytest.Session) -> None:
    """End them also where tests stopped in the middle (``-x``, Ctrl-C)."""
    session.config.stash.setdefault(_OPEN, ExitStack()).close()


@pytest.fixture(scope="session")
def site(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Site:
    """The server with its robots."""
    _ = request.getfixturevalue("browser")  # without one there is no use in a server
    opened = request.config.stash.setdefault(_OPEN, ExitStack())
    return opened.enter_context(made(tmp_path_factory.mktemp("site")))


@pytest.fixture(scope="session")
def browser(request: pytest.FixtureRequest) -> Browser:
    """The browser."""
    from playwright.sync_api import expect  # only where it is there

    expect.set_options(timeout=_WAIT_MS)
    opened = request.config.stash.setdefault(_OPEN, ExitStack())
    return opened.enter_context(chromium())


class _Pages:
    def __init__(self, browser: Browser, site: Site) -> None:
        self._browser, self._site = browser, site
        self.watched: list[Watched] = []

    def __call__(
        self, name: str = "", width: int = 1440, theme: str = "light", *, height: int = 900,
        expects: Sequence[str] = (), at: str = "", **options: object,
    ) -> Page:  # fmt: skip
        url = at or self._site.url
        more = {"locale": "en-GB", "timezone_id": "Europe/Berlin", "proxy": only(url), **options}
        context = self._browser.new_context(
            base_url=url, viewport={"width": width, "height": height},
            color_scheme="dark" if theme == "dark" else "light", **more,  # type: ignore[arg-type]  # Playwright's own options, by name
        )  # fmt: skip
        context.set_default_timeout(_WAIT_MS)
        self._set(context, url, "theme", theme)
        if name:
            self._set(context, url, COOKIE, self._site.session(name))
        page = context.new_page()
        self.watched.append(Watched(page, url, expects))
        return page

    def _set(self, context: BrowserContext, url: str, name: str, value: str) -> None:
        context.add_cookies([{"name": name, "value": value, "url": url}])

    def close(self) -> None:
        for one in self.watched:
            one.page.context.close()


@pytest.fixture
def page_as(browser: Browser, site: Site) -> Iterator[PageAs]:
    """What opens pages; the test fails at its end when something went wrong in one of them."""
    pages = _Pages(browser, site)
    yield pages
    pages.close()
    troubles = [f"{one.page.url}: {trouble}" for one in pages.watched for trouble in one.troubles]
    assert not troubles, "\n".join(troubles)
