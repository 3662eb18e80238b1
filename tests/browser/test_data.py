"""The page of data in a browser: variables, the window, plots, marks, what one takes along."""

from __future__ import annotations

import re
from datetime import UTC, datetime
from typing import TYPE_CHECKING
from urllib.parse import parse_qs, urlsplit

import pytest
from playwright.sync_api import expect

from tests.browser import hostile, record
from tests.browser.conftest import PageAs
from tests.browser.page_checks import RESTART
from tests.browser.site import Site

if TYPE_CHECKING:
    from playwright.sync_api import Page, Route

PATH = "/robots/ropod_001/data"
VOLTS, SPEED = "battery.volts", "ros_ropod_odom.twist_linear_x"
_DRAWN = """(n) => {
    const cells = [...document.querySelectorAll(".plot-readout tbody tr td:nth-of-type(6)")];
    return cells.length === n && cells.every((cell) => cell.textContent);
}"""


def open_data(page: Page, *names: str, robot: str = "ropod_001", **more: str) -> None:
    """Show variables of a robot and wait until they are drawn."""
    query = [*(f"v={name}" for name in names), *(f"{key}={value}" for key, value in more.items())]
    page.goto(f"/robots/{robot}/data?{'&'.join(query)}")
    page.locator(".tree").wait_for(state="attached")
    if names and "mode" not in more:
        drawn(page, len(names))


def drawn(page: Page, number: int) -> None:
    """Wait until so many variables are drawn."""
    page.wait_for_function(_DRAWN, arg=number)


def stamp(site: Site, minutes: float) -> str:
    """Return a time from when the record was made backwards."""
    at_s = site.now_ns / 1e9 + 60 * minutes
    return datetime.fromtimestamp(at_s, UTC).strftime("%Y-%m-%dT%H:%M:%S.%fZ")


def test_plots_wait_for_the_script_that_draws_them(page_as: PageAs) -> None:
    """On a slow connection the script is loaded last; the page must not use it before."""
    page = page_as("viewer")
    held: list[Route] = []
    page.route("**/vendor/uplot.js", lambda route: held.append(route))
    with page.expect_response("**/data/variables"):
        page.goto(f"{PATH}?v={VOLTS}", wait_until="commit")
    page.evaluate("() => new Promise((done) => setTimeout(done, 1000))")  # time for the mistake
    held[0].continue_()
    drawn(page, 1)


def test_choosing_variables_by_keys_and_words(page_as: PageAs) -> None:
    page = page_as("viewer")
    open_data(page)
    expect(page.get_by_text("Choose what you want to see")).to_be_visible()
    page.locator('.tree [tabindex="0"]').focus()
    for key in ("ArrowDown", " "):
        page.keyboard.press(key)
    expect(page).to_have_url(re.compile(r"\?v=battery\.volts$"))
    page.get_by_role("searchbox").fill("odom linear m/s")
    leaf = page.get_by_role("treeitem", name="twist_linear_x, m/s")
    expect(leaf).to_have_attribute("aria-checked", "false")
    leaf.click()
    expect(leaf).to_have_attribute("aria-checked", "true")
    drawn(page, 2)
    plot = page.get_by_role("combobox", name=f"Plot of {SPEED}")
    plot.select_option("1")
    expect(page.locator(".plot-panel")).to_have_count(1)
    plot.select_option(label="New plot")
    expect(page.locator(".plot-panel")).to_have_count(2)
    page.locator("#shown li").nth(1).drag_to(page.locator(".plot-panel").first)
    expect(page.locator(".plot-panel")).to_have_count(1)
    expect(page).to_have_url(re.compile("v=1%3A"))
    page.get_by_role("button", name=f"Take {VOLTS} away").first.click()
    expect(page).to_have_url(re.compile(rf"\?v={SPEED}$"))
    page.get_by_role("searchbox").fill("no such thing")
    expect(page.get_by_text("Nothing is called so")).to_be_visible()


def test_the_window_by_bar_fields_and_menu(page_as: PageAs, site: Site) -> None:
    page = page_as("viewer")
    open_data(page, VOLTS, mission="transport-1")
    begin = page.get_by_role("slider", name="Beginning of the window")
    expect(begin).to_have_attribute("aria-valuetext", re.compile("20"))
    before = int(begin.get_attribute("aria-valuenow") or 0)
    assert before == pytest.approx(site.now_ns / 1e9 - 50 * 60 - 36, abs=2)
    begin.press("ArrowRight")
    expect(page).to_have_url(re.compile("from=.*&to="))
    assert int(begin.get_attribute("aria-valuenow") or 0) > before
    page.locator("#goto summary").click()
    page.get_by_role("button", name="bumper pressed").click()
    expect(begin).to_have_attribute("aria-valuenow", str(round(site.now_ns / 1e9 - 36 * 60 - 6)))
    page.get_by_role("button", name="The newest 10 min").click()
    expect(begin).not_to_have_attribute(
        "aria-valuenow", str(round(site.now_ns / 1e9 - 36 * 60 - 6))
    )


def test_back_undoes_what_was_moved_and_chosen(page_as: PageAs, site: Site) -> None:
    page = page_as("viewer")
    open_data(page, VOLTS, mission="transport-1")
    begin = page.get_by_role("slider", name="Beginning of the window")
    first = begin.get_attribute("aria-valuenow") or ""
    for _ in range(3):  # keys that follow each other fast are one step
        begin.press("ArrowRight")
    page.get_by_role("button", name=re.compile("Take .*volts away")).first.click()
    expect(page.get_by_text("Choose what you want to see")).to_be_visible()
    page.go_back()
    drawn(page, 1)
    expect(begin).not_to_have_attribute("aria-valuenow", first)
    page.go_back()
    expect(page).to_have_url(re.compile("mission=transport-1"))
    expect(begin).to_have_attribute("aria-valuenow", first)


def test_a_window_is_shown_whole_and_everything_is_what_is_known(
    page_as: PageAs, site: Site
) -> None:
    page = page_as("viewer")
    asked: list[str] = []
    page.on("request", lambda request: asked.append(request.url))
    open_data(page, VOLTS, **{"from": "1970-01-01T00:00:00Z", "to": stamp(site, 0)})
    (query,) = (parse_qs(urlsplit(url).query) for url in asked if "/query?" in url)
    assert float(query["from"][0]) == 0
    assert float(query["to"][0]) > site.now_ns / 1e9
    expect(page.get_by_label("From", exact=True)).to_have_value(re.compile("^1970-01-01T01:00"))
    expect(page.locator(".brush-recorded").first).to_be_attached()
    page.get_by_role("button", name="Everything", exact=True).first.click()
    begin = page.get_by_role("slider", name="Beginning of the window")
    expect(begin).to_have_attribute("aria-valuenow", re.compile(r"^\d{10}$"))
    assert int(begin.get_attribute("aria-valuenow") or 0) > site.now_ns / 1e9 - 2 * 3600


def test_few_questions_for_the_first_plot_and_all_around_it(page_as: PageAs) -> None:
    page = page_as("technician")
    asked: list[str] = []
    page.on("request", lambda request: asked.append(request.url))
    open_data(page, VOLTS)
    expect(page.locator(".brush-recorded").first).to_be_attached()
    expect(page.locator(".plot-lane").first).to_be_attached()
    paths = [urlsplit(url).path.rpartition("/")[2] for url in asked]
    assert len(paths) <= 15
    for once in ("variables", "query", "coverage", "around", "statistics"):
        assert paths.count(once) == 1
    assert "alarm-count" not in paths
    assert paths.index("query") < paths.index("coverage")


def test_a_mission_that_is_not_there_is_said(page_as: PageAs) -> None:
    page = page_as("viewer", expects=["404"])
    open_data(page, VOLTS, mission="no-such-mission")
    expect(page.locator("#data-problem")).to_contain_text("no such mission")
    page.get_by_role("button", name="The newest 10 min").click()
    expect(page).to_have_url(re.compile("from="))
    assert "mission=" not in page.url


def test_one_against_another_and_how_often(page_as: PageAs) -> None:
    page = page_as("viewer")
    names = "ros_ropod_odom.pose_x", "ros_ropod_odom.pose.y"
    open_data(page, *names, mode="xy")
    expect(page.get_by_text("coloured by time")).to_be_visible()
    page.get_by_role("button", name="How often").click()
    expect(page.get_by_text(re.compile(r"\d values"))).to_have_count(2)
    expect(page).to_have_url(re.compile("mode=hist"))
    page.go_back()
    expect(page.get_by_text("coloured by time")).to_be_visible()


def test_what_is_drawn_against_what_is_chosen_from_all(page_as: PageAs) -> None:
    page = page_as("viewer")
    open_data(page, VOLTS, mode="xy")
    expect(page.get_by_text("Choose two variables: one across, one up.")).to_be_visible()
    across, up = (page.get_by_role("combobox", name=name) for name in ("Across", "Up"))
    expect(across).to_have_value(VOLTS)
    expect(up).to_have_value("")
    up.select_option("battery.charge_percent")
    expect(page.get_by_text("coloured by time")).to_be_visible()
    expect(page).to_have_url(re.compile(rf"x={VOLTS}&y=battery\.charge_percent"))
    page.get_by_role("button", name=f"Take {VOLTS} away").click()
    expect(across).to_have_value(VOLTS)
    expect(page.get_by_text("coloured by time")).to_be_visible()


def test_headers_and_stamps_stand_last_and_names_break_between_words(page_as: PageAs) -> None:
    page = page_as("viewer")
    open_data(page, SPEED)
    page.get_by_role("treeitem", name="ros_ropod_odom, ").click()
    names = page.locator('.tree [data-node^="item:ros_ropod_odom "]').evaluate_all(
        "(leaves) => leaves.map((leaf) => leaf.dataset.node.split('.').pop())"
    )
    stamps = [name for name in names if "stamp" in name or name.startswith("header")]
    assert stamps and names[-len(stamps) :] == stamps
    name = page.locator("#shown .shown-name")
    assert name.inner_html().startswith("ros_<wbr>ropod_<wbr>odom.<wbr>twist_")


def test_two_missions_over_each_other(page_as: PageAs) -> None:
    page = page_as("viewer")
    open_data(page, VOLTS)
    page.get_by_role("button", name="Compare missions").click()
    page.locator("#compare option").nth(3).wait_for(state="attached")
    page.get_by_role("button", name="Compare", exact=True).click()
    drawn(page, 2)
    expect(page.locator(".plot-readout")).to_contain_text(hostile.MISSION)
    expect(page).to_have_url(re.compile("compare=transport-"))
    page.get_by_role("button", name="Back to one window").click()
    drawn(page, 1)


def test_marking_a_window_and_a_moment(page_as: PageAs, site: Site) -> None:
    page = page_as("operator")
    open_data(page, VOLTS, **{"from": stamp(site, -48), "to": stamp(site, -46)})
    page.get_by_role("button", name="Mark incident").click()
    page.get_by_role("textbox", name="What happened").fill(hostile.NOTE)
    page.get_by_role("button", name="Mark", exact=True).click()
    happened = page.locator(".plot-list li")
    expect(happened.filter(has_text=hostile.SCRIPT)).to_be_attached()
    page.get_by_role("button", name="Add note").click()
    page.get_by_role("textbox", name="Note").fill("the floor was wet")
    page.get_by_role("button", name="Add", exact=True).click()
    expect(happened.filter(has_text="the floor was wet")).to_be_attached()
    found = site.ask("/robots/ropod_001/missions/transport-1")["notes"][-1]
    assert found["at"][:16] == stamp(site, -47)[:16]


def test_taking_along_what_is_seen(page_as: PageAs, site: Site) -> None:
    page = page_as("technician")
    open_data(page, VOLTS, **{"from": stamp(site, -40), "to": stamp(site, -39)})
    page.get_by_role("button", name="Download").click()
    page.get_by_role("button", name="Make the file").click()
    link = page.locator(".work a")
    link.wait_for()
    with page.expect_download() as download:
        link.click()
    lines = download.value.path().read_text().splitlines()
    assert lines[0].split(",")[-1] == "volts"
    assert len(lines) == 31


def test_asking_the_robot_for_more(page_as: PageAs, site: Site) -> None:
    page = page_as("technician")
    open_data(page, VOLTS, **{"from": stamp(site, 0.02), "to": stamp(site, 0.1)})
    page.get_by_role("button", name="Ask the robot for it").click()
    expect(page.locator(".work")).to_contain_text("Data from the robot")
    assert site.ask("/robots/ropod_001/fetches")[0]["who"].endswith("technician")
    page.get_by_role("button", name="Go to the newest values").click()
    expect(page.get_by_text("no values in this window")).to_have_count(0)


def test_live_values_move_the_window(page_as: PageAs, site: Site) -> None:
    page = page_as("viewer")
    open_data(page, VOLTS)
    page.get_by_role("button", name="Live").click()
    expect(page.locator("#live")).to_have_attribute("data-state", "on")
    expect(page).to_have_url(re.compile("live=1"))
    end = page.get_by_label("to", exact=True)
    before = end.input_value()
    page.wait_for_timeout(1100)  # the fields tell whole seconds
    site.robots["ropod_001"].measure(
        record.BATTERY, volts=21.5, charge_percent=50.0, charging=False
    )
    expect(end).not_to_have_value(before)
    page.locator(".plot-hands").focus()
    page.keyboard.press("-")
    expect(page.locator("#live")).to_have_text("Go on live")


def test_hostile_names_are_text(page_as: PageAs) -> None:
    page = page_as("viewer")
    page.goto(f"{PATH}?v=hostile.text&v=<img src=x onerror=document.title=1>")
    drawn(page, 1)
    expect(page.get_by_text("“<img src=x onerror=document.title=1>” is not")).to_be_visible()
    page.get_by_role("searchbox").fill("hostile")
    expect(page.locator(".tree")).to_contain_text("text")
    page.goto("/robots/ropod_002/data")
    expect(page.get_by_text("Nothing has come from this robot yet")).to_be_visible()
    assert page.title().endswith("Data of ropod_002 · Amberbox")


def test_a_restart_loses_nothing(page_as: PageAs, site: Site) -> None:
    page = page_as("viewer", expects=RESTART)
    open_data(page, VOLTS)
    page.get_by_role("treeitem", name="ros_ropod_drive, ").click()
    page.locator(".plot-hands").focus()
    for key in ("+", "ArrowRight"):
        page.keyboard.press(key)
    drawn(page, 1)
    url, cursor = page.url, page.locator(".plot-time").inner_text()
    site.restart()
    expect(page.locator("html")).to_have_attribute("data-feed", "live")
    assert (page.url, page.locator(".plot-time").inner_text()) == (url, cursor)
    expect(page.get_by_role("treeitem", name="ros_ropod_drive, ")).to_have_attribute(
        "aria-expanded", "true"
    )
    page.keyboard.press("-")
    drawn(page, 1)
