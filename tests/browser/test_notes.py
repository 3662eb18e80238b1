"""A note on any moment of a robot's data, in a browser."""

from __future__ import annotations

from playwright.sync_api import expect

from amberbox.core.safe_text import escape_hidden
from tests.browser import hostile
from tests.browser.conftest import PageAs
from tests.browser.page_checks import EVERY_LOOK, judge, shot
from tests.browser.site import Site
from tests.browser.test_data import VOLTS, open_data, stamp


def test_a_moment_is_annotated_where_no_mission_was_under_way(page_as: PageAs, site: Site) -> None:
    page = page_as("operator")
    open_data(page, VOLTS, **{"from": stamp(site, -17), "to": stamp(site, -15)})
    page.get_by_role("button", name="Add note").click()
    dialog = page.get_by_role("dialog")
    expect(dialog.get_by_role("button", name="Add", exact=True)).to_be_enabled()
    expect(dialog.get_by_role("combobox", name="Mission")).to_be_hidden()
    dialog.get_by_role("textbox", name="Note").fill(hostile.NOTE)
    judge(page, "note-dialog", EVERY_LOOK, whole=False)
    dialog.get_by_role("button", name="Add", exact=True).click()
    expect(page.get_by_text("The note is added.")).to_be_visible()
    expect(
        page.locator(".plot-list li").filter(has_text=escape_hidden(hostile.NOTE))
    ).to_be_attached()
    (found,) = site.ask("/robots/ropod_001/notes")[:1]
    assert (found["text"], found["mission"]) == (hostile.NOTE, "")
    shot(page, "note-marker")
