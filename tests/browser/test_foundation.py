"""The fixtures of page tests: a page opens, and errors in it are detected."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, HTTPServer
from threading import Thread
from typing import TYPE_CHECKING, Any

import pytest
from playwright.sync_api import expect

from amberbox.testing.clock import wait_until
from tests.browser import hostile
from tests.browser.conftest import PageAs
from tests.browser.page_checks import EVERY_LOOK, Watched, axe, judge
from tests.browser.site import Site, fresh

if TYPE_CHECKING:
    from playwright.sync_api import Page

_SOME = "main > section:nth-of-type(-n+3)"
"""The whole page of the API takes axe many seconds, and is the same thing a hundred times."""


def test_the_page_of_the_api(page_as: PageAs) -> None:
    page = page_as("viewer")
    page.goto("/api/docs")
    expect(page.get_by_role("heading", name="Amberbox API")).to_be_visible()
    judge(page, "api-docs", EVERY_LOOK, within=("nav", _SOME), whole=False)


@pytest.fixture(scope="module")
def empty(browser: object, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Site]:
    """A server without any account."""
    with fresh(tmp_path_factory.mktemp("fresh")) as found:
        yield found


def test_the_page_to_set_up(page_as: PageAs, empty: Site) -> None:
    page = page_as("", at=empty.url)
    page.goto("/setup")
    expect(page.get_by_role("heading", name="Set up this server")).to_be_visible()
    page.get_by_label("Name").fill("anna")
    judge(page, "setup", EVERY_LOOK)


def test_somebody_sets_the_server_up(page_as: PageAs, empty: Site) -> None:
    page = page_as("", at=empty.url, expects=["status of 4", " POST "])
    page.goto("/setup")
    page.get_by_label("Name").fill("anna")
    for again, then in (("four other words", "alert"), ("four words for it", "heading")):
        page.get_by_label("Password", exact=True).fill("four words for it")
        page.get_by_label("Password again").fill(again)
        page.get_by_role("button", name="Make the admin").click()
        expect(page.get_by_role("alert")).to_have_count(1 if then == "alert" else 0)
        axe(page)
    expect(page.get_by_role("heading", name="Done")).to_be_visible()


def heard(page: Page, watched: Watched) -> int:
    """Process the browser's pending messages; return the number of lines so far."""
    page.wait_for_timeout(20)
    return len(watched.heard)


def test_what_goes_wrong_in_a_page_is_noticed(page_as: PageAs, site: Site) -> None:
    page = page_as("viewer", expects=["404 GET", "status of 404", "boom", "wrong"])
    page.goto("/api/v1/nothing")
    page.evaluate("() => console.error('wrong')")
    page.evaluate("() => { setTimeout(() => { throw new Error('boom') }) }")
    page.wait_for_function("() => true")
    (watched,) = page_as.watched
    wait_until(lambda: heard(page, watched) >= 4, "all is heard")
    assert watched.heard[0] == f"404 GET {site.url}/api/v1/nothing"
    assert any("boom" in one for one in watched.heard)
    assert not watched.troubles
    watched.expects = ()
    assert len(watched.troubles) == len(watched.heard)
    watched.heard.clear()


@contextmanager
def stranger() -> Iterator[tuple[str, list[str]]]:
    """Serve a foreign site; yield its address, and the requests to it."""
    asked: list[str] = []

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            asked.append(self.path)
            self.send_error(404)

        def log_message(self, format: str, *args: object) -> None:
            """Print nothing."""

    with HTTPServer(("127.0.0.1", 0), Handler) as server:
        Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}", asked
        server.shutdown()


def test_nobody_but_the_site_is_reached(page_as: PageAs) -> None:
    page = page_as("viewer", expects=["another host", "ERR_PROXY"])
    (watched,) = page_as.watched
    with stranger() as (address, asked):
        page.goto("about:blank")
        page.set_content(f'<img src="{address}/a"><img src="http://198.51.100.1/b">'
                         '<img src="https://example.com/c">')  # fmt: skip
    assert asked == []
    hosts = [one for one in watched.heard if one.startswith("asked another host")]
    failed = [one for one in watched.heard if "ERR_PROXY_CONNECTION_FAILED" in one]
    assert len(hosts) == 3 and len(failed) >= 3
    watched.heard.clear()


def card(site: Site, robot: str) -> dict[str, Any]:
    """Return the server's card of a robot."""
    found: dict[str, Any] = site.ask(f"/robots/{robot}")
    return found


def test_the_robots_are_as_they_say(site: Site) -> None:
    cards = {card["robot"]: card for card in site.ask("/robots")}
    assert cards["ropod_001"]["level"] == "error" and cards["ropod_001"]["alarms"] == 1
    assert cards["ropod_001"]["diagnosis"]["faults"] == ["laser_front#silent"]
    assert cards["ropod_002"]["level"] == "warn"
    wait_until(lambda: card(site, "ropod_002")["model"] == hostile.MODEL, "its folder is read")
    assert not cards["ropod_003"]["online"] and cards["ropod_003"]["backlog_rows"] == 1234


def test_a_robot_says_something_leaves_and_comes(site: Site) -> None:
    def level(component: str = "imu") -> str:
        status = site.ask("/robots/ropod_001/status")
        found = {c["name"]: str(c["condition"]["level"]) for c in status["components"]}
        return found[component]

    site.say("ropod_001", "imu", "warn", reason="it shakes")
    wait_until(lambda: level() == "warn", "the server hears of it")
    site.robots["ropod_001"].leave()
    wait_until(lambda: not site.is_online("ropod_001"), "the robot is gone")
    site.say("ropod_001", "imu", "ok")
    site.robots["ropod_001"].come()
    wait_until(lambda: site.is_online("ropod_001") and level() == "ok", "it is back")


def test_the_server_is_restarted(site: Site) -> None:
    before = site.url
    site.restart()
    wait_until(lambda: site.is_online(*site.robots), "the robots came back by themselves")
    assert site.url == before


def test_paper_says_when_by_whom_and_of_what(page_as: PageAs) -> None:
    page = page_as("technician")
    page.goto("/robots/ropod_001/data?from=2026-01-02T03:04:05Z&to=2026-01-02T04:04:05Z")
    expect(page.locator("#window [name=from]")).to_have_value(re.compile("2026-01-02T04:04"))
    printed = page.locator("[data-printed]")
    expect(printed).to_be_hidden()
    page.emulate_media(media="print")
    page.evaluate("dispatchEvent(new Event('beforeprint'))")
    expect(printed).to_contain_text("by technician, http://localhost")
    expect(page.locator("[data-printed-window]")).to_have_text(
        "2 Jan 2026, 04:04:05 to 2 Jan 2026, 05:04:05 (Europe/Berlin)"
    )


def test_what_is_closed_stays_closed_on_paper(page_as: PageAs) -> None:
    page = page_as("viewer")
    page.goto("/knowledge/ropod_001")
    folded = page.locator(".sheet details:not([open]) li").first
    page.emulate_media(media="print")
    expect(folded).to_be_hidden()
