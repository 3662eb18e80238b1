"""Every page there is: for those who cannot see it, on a phone, in the dark, with hostile texts."""

from __future__ import annotations

import re
import urllib.error
import urllib.request
from collections.abc import Iterable, Mapping
from html import unescape

import pytest
from playwright.sync_api import expect

from amberbox.server.http.auth import COOKIE
from amberbox.server.routes import PAGES as PAGE_ROUTES
from amberbox.testing.clock import PATIENCE_S
from tests.browser.conftest import PageAs
from tests.browser.hostile import COMMAND, EARLIER_RUN, EQUATIONS, RUN
from tests.browser.page_checks import LOOKS, axe, look, no_sideways_scroll, no_squeezed_values, shot
from tests.browser.site import Site

PAGES: Mapping[str, str] = {
    "/": "/",
    "/robots/{robot}": "/robots/ropod_002",
    "/robots/{robot}/data": "/robots/ropod_001/data?v=hostile&from=now-2h",
    "/robots/{robot}/diagnosis": "/robots/ropod_001/diagnosis?details=1",
    "/robots/{robot}/models/{name}": f"/robots/ropod_001/models/{EQUATIONS}",
    "/robots/{robot}/commands": "/robots/ropod_001/commands?action=drive",
    "/robots/{robot}/commands/{id}": f"/robots/ropod_001/commands/{COMMAND}",
    "/commands": "/commands",
    "/robots/{robot}/experiments": "/robots/ropod_002/experiments",
    "/experiments": "/experiments",
    "/runs": "/runs",
    "/runs/{id}": f"/runs/{RUN}",
    "/runs/{id}/report": f"/runs/{EARLIER_RUN}/report",
    "/runs/{id}/comparison": f"/runs/{RUN}/comparison?run={EARLIER_RUN}",
    "/tasks": f"/tasks?run={RUN}",
    "/alarms": "/alarms?state=all",
    "/alarms/{id}": "/alarms/1",
    "/recordings": "/recordings",
    "/recordings/{robot}": "/recordings/ropod_001",
    "/downloads": "/downloads",
    "/detectors": "/detectors",
    "/knowledge": "/knowledge",
    "/knowledge/{robot}": "/knowledge/ropod_001",
    "/account": "/account",
    "/admin": "/admin",
    "/admin/users": "/admin/users",
    "/admin/teams": "/admin/teams",
    "/admin/robots": "/admin/robots",
    "/admin/keys": "/admin/keys",
    "/admin/settings/{setting}": "/admin/settings/notifications",
    "/admin/audit": "/admin/audit",
    "/admin/health": "/admin/health",
    "/admin/system": "/admin/system",
    "/help": "/help",
    "/licences": "/licences",
    "/sign-in": "/sign-in",
}
"""Each page by its route, and where to find one of it that shows much."""
ELSEWHERE = {"/setup", "/in", "/models"}
"""Pages that a server of its own shows (test_foundation.py, tests/demo), and a former address."""
DEEPER = {"/robots/{robot}/commands/{id}", "/robots/{robot}/models/{name}"}
"""Pages whose addresses are as long as those of fragments."""
FOLDED_WHERE_NARROW = "/robots/{robot}/data"
"""What there is to see is folded away on a phone as the page is loaded."""


def is_page(path: str) -> bool:
    """Return whether a path is a page, not a fragment or a download."""
    parts = ("/pieces/", "/static/", "/help/")
    return not path.startswith(parts) and "." not in path and path.count("/") < 4


def test_no_page_is_left_out() -> None:
    paths = {path for one in PAGE_ROUTES for method, path in one.rules if method == "GET"}
    assert {path for path in paths if is_page(path)} == set(PAGES) - DEEPER | ELSEWHERE


@pytest.mark.parametrize("route", PAGES)
def test_page(page_as: PageAs, route: str) -> None:
    page = page_as("" if route == "/sign-in" else "admin")
    page.goto(PAGES[route])
    for theme, width in LOOKS:
        with look(page, theme, width):
            if route == FOLDED_WHERE_NARROW:
                page.reload()
            expect(page.locator("h1").first).to_be_visible()
            axe(page)
            no_sideways_scroll(page)
            if width < 600:
                no_squeezed_values(page)
            assert not page.title().startswith("1"), "a text of somebody has run as a script"
            shot(page, re.sub(r"\W+", "-", route).strip("-") or "home", whole=False)


def test_no_link_leads_nowhere(site: Site) -> None:
    led = links(site, "admin", PAGES.values())
    broken = {f"{href} on {path}: {status}" for href, path in led.items()
              if (status := got(site, "admin", href)[0]) >= 400}  # fmt: skip
    assert broken == set()


def test_what_a_viewer_is_led_to_a_viewer_may_see(site: Site) -> None:
    pages = [path for path in PAGES.values() if not path.startswith(("/admin", "/downloads"))]
    led = links(site, "viewer", pages)
    refused = {f"{href} on {path}" for href, path in led.items()
               if got(site, "viewer", href)[0] in (401, 403)}  # fmt: skip
    assert refused == set()


def links(site: Site, name: str, paths: Iterable[str]) -> Mapping[str, str]:
    """Return the links of pages on this server, each with the page that contains it."""
    found: dict[str, str] = {}
    for path in paths:
        for href in re.findall(r'<a [^>]*href="(/[^"#]*)', got(site, name, path)[1]):
            found.setdefault(unescape(href), path)
    return found


def got(site: Site, name: str, path: str) -> tuple[int, str]:
    """Request a page as a person; return the status and the text."""
    headers = {"Cookie": f"{COOKIE}={site.session(name)}", "Accept": "text/html"}
    request = urllib.request.Request(site.url + path, headers=headers)
    try:
        with urllib.request.urlopen(request, timeout=PATIENCE_S) as answer:
            return answer.status, answer.read().decode("utf-8", "replace")
    except urllib.error.HTTPError as error:
        return error.code, ""
