"""Plots: drawn points, zooming, the cursor, markers and gaps, live values."""

from __future__ import annotations

import math
import re
import time
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

import pytest
from playwright.sync_api import expect

from amberbox.server.web.assets import address
from amberbox.testing.clock import PATIENCE_S
from tests.browser import hostile, record
from tests.browser.conftest import PageAs
from tests.browser.page_checks import axe, no_sideways_scroll, shot
from tests.browser.plotting import (
    CHARGE,
    ENABLED,
    MINUTE,
    ODOM,
    REMARK,
    ROBOT,
    SPEED,
    STATE,
    VOLTS,
    drag,
    now,
    open_plots,
    point,
    settle,
)
from tests.browser.site import Site

if TYPE_CHECKING:
    from playwright.sync_api import Page, Route

INK_BETWEEN = """([from, to]) => {
    const canvas = document.querySelector(".plot-canvas canvas");
    const over = document.querySelector(".plot-canvas .u-over").getBoundingClientRect();
    const box = canvas.getBoundingClientRect();
    const scale = canvas.width / box.width;
    const width = Math.round(over.width * scale);
    const top = (over.top - box.top + over.height * from) * scale;
    const height = Math.round(over.height * scale * (to - from));
    const pen = canvas.getContext("2d");
    const { data } = pen.getImageData((over.left - box.left) * scale, top, width, height);
    const found = new Set();
    for (let n = 0; n < data.length; n += 4) {
        if (data[n + 2] > data[n] + 60 && data[n + 3] > 60) found.add((n / 4) % width);
    }
    return found.size;
}"""
"""In how many columns of pixels there is blue, the first variable's colour, at a height."""


def hour(site: Site) -> tuple[float, float]:
    return site.now_ns / 1e9 - 60 * MINUTE, site.now_ns / 1e9


def at(site: Site, offset_ns: int) -> float:
    return (site.now_ns + offset_ns) / 1e9


def test_a_spike_of_one_row_is_drawn_however_far_one_zooms_out(page_as: PageAs, site: Site) -> None:
    page = page_as("viewer")
    open_plots(page, *hour(site), SPEED)
    for factor in (1, 24, 24 * 30):
        _, to = hour(site)
        page.evaluate("([from, to]) => stack.window(from, to)", [to - factor * 3600, to])
        settle(page)
        drawn = now(page)["drawn"]["speed"]
        assert drawn["high"] == record.SPIKE
        assert drawn["of"] > 100_000 > 6 * 1440 > drawn["points"]
        assert 1 <= page.evaluate(INK_BETWEEN, [0.3, 0.4]) <= 6  # one thin line up there
    expect(page.get_by_role("row", name="Speed")).to_contain_text("99")
    expect(page.locator(".plot-key").first).to_contain_text(re.compile(r"aggregated 1:\d"))


def test_dragging_zooms_and_asks_again_without_a_flicker(page_as: PageAs, site: Site) -> None:
    page = page_as("viewer")
    open_plots(page, *hour(site), SPEED, VOLTS)
    held: list[Route] = []
    page.route("**/query?*", lambda route: held.append(route))
    drag(page, 0.30, 0.35)
    page.evaluate("() => new Promise((done) => requestAnimationFrame(() => setTimeout(done)))")
    from_s, to_s = hour(site)
    assert now(page)["from"] == pytest.approx(from_s + 0.30 * 3600, abs=20)
    assert now(page)["to"] == pytest.approx(from_s + 0.35 * 3600, abs=20)
    assert page.evaluate(INK_BETWEEN, [0.0, 1.0]) > 500  # the old rows, wider
    assert now(page)["drawn"]["speed"]["of"] > 100_000
    page.unroute("**/query?*")
    for route in held:
        route.continue_()
    settle(page)
    drawn = now(page)["drawn"]["speed"]
    assert 180 * record.ODOM_HZ <= drawn["of"] <= 1.1 * 180 * record.ODOM_HZ
    assert page.evaluate("() => heard.at(-1)") == [now(page)["from"], now(page)["to"]]
    page.locator(".plot-canvas .u-over").first.dblclick(position={"x": 300, "y": 60})
    settle(page)
    assert (now(page)["from"], now(page)["to"]) == pytest.approx((from_s, to_s))


def test_while_one_turns_the_wheel_only_the_last_window_is_asked_for(
    page_as: PageAs, site: Site
) -> None:
    page = page_as("viewer")
    open_plots(page, *hour(site), SPEED)
    asked: list[str] = []
    page.on(
        "request", lambda request: asked.append(request.url) if "/query?" in request.url else None
    )
    point(page, 0.5)
    page.keyboard.down("Control")
    for _ in range(12):
        page.mouse.wheel(0, -120)
    page.keyboard.up("Control")
    settle(page)
    assert now(page)["to"] - now(page)["from"] < 1200
    assert 1 <= len(asked) <= 4
    page.keyboard.press("Tab")
    page.get_by_role("button", name="Back").click()
    assert now(page)["to"] - now(page)["from"] == pytest.approx(3600)


def test_everything_works_by_keyboard(page_as: PageAs, site: Site) -> None:
    page = page_as("viewer", theme="dark")
    open_plots(page, *hour(site), SPEED, STATE)
    plots = page.get_by_role("group", name="Plots over time")
    plots.focus()
    begin, end = hour(site)

    def press(key: str) -> dict[str, Any]:
        page.keyboard.press(key)
        settle(page)
        return now(page)

    first = press("ArrowRight")["cursor"]
    assert begin < first < press("ArrowRight")["cursor"] < end
    expect(page.get_by_role("status")).to_contain_text(
        re.compile(r"Speed .* \(lost: the queue was full\); State (IDLE|DRIVING|BLOCKED)$")
    )
    assert press("+")["to"] - now(page)["from"] == pytest.approx(1800)
    assert press("Shift+ArrowLeft")["from"] < begin + 1800
    assert press("-")["to"] - now(page)["from"] == pytest.approx(3600)
    assert press("Home")["from"] == begin
    assert press("Escape")["from"] != begin
    expect(page.get_by_role("row", name="State")).to_contain_text("every value")


def test_gaps_are_hatched_and_say_why(page_as: PageAs, site: Site) -> None:
    page = page_as("viewer")
    open_plots(page, *hour(site), SPEED, VOLTS)
    legend = page.get_by_role("list", name="What is missing")
    expect(legend).to_contain_text("lost or damaged")
    middle = sum(record.GAP_NS) // 2
    page.evaluate("(time) => stack.cursorTo(time)", at(site, middle))
    expect(page.get_by_role("row", name="Speed")).to_contain_text(f"({record.LOST})")
    expect(page.get_by_role("row", name="Voltage")).to_contain_text("26.")
    page.evaluate(
        "([a, b]) => stack.window(a, b)", [at(site, record.GAP_NS[0] + 10**10), at(site, middle)]
    )
    settle(page)
    assert page.evaluate(INK_BETWEEN, [0.0, 1.0]) == 0  # no line over what is lost
    expect(page.locator(".plot-key").first).to_contain_text(
        "No values in this window: lost or damaged"
    )


def test_what_was_refused_leads_to_the_file(page_as: PageAs, site: Site) -> None:
    page = page_as("viewer")
    since, until = (datetime.fromtimestamp(at(site, n * 10**9), UTC) for n in (-600, 60))
    gap = {"item": ODOM, "from": since.isoformat(), "to": until.isoformat(), "kind": "refused",
           "reason": "refused: journal/000002-b-0001.mcap: altered"}  # fmt: skip
    items = {ODOM: {"gaps": [gap], "more": False}}
    around = {"gaps": {"from": at(site, -(10**13)), "to": at(site, 10**13), "items": items}}
    page.route("**/data/around?*", lambda route: route.fulfill(json=around))
    open_plots(page, at(site, -3600 * 10**9), at(site, 60 * 10**9), SPEED)
    legend = page.get_by_role("list", name="What is missing")
    expect(legend).to_have_text(re.compile("^damaged: the server has the file, and set it aside"))
    link = legend.get_by_role("link", name="Look at the file")
    expect(link).to_have_attribute("href", f"/recordings/{ROBOT}?show=trouble#journals")


def test_gaps_that_cannot_be_had_are_asked_for_again(page_as: PageAs, site: Site) -> None:
    page = page_as("viewer", expects=["503"])
    page.route("**/data/around?*", lambda route: route.fulfill(status=503, json={}))
    open_plots(page, *hour(site), SPEED)
    legend = page.get_by_role("list", name="What is missing")
    expect(legend).to_contain_text("cannot tell at the moment")
    gap = [at(site, record.GAP_NS[0] - 10**10), at(site, record.GAP_NS[1] + 10**10)]
    page.evaluate("([from, to]) => stack.window(from, to)", gap)
    settle(page)
    assert 0 < page.evaluate(INK_BETWEEN, [0.0, 1.0]) < 400  # no line over what may be missing
    page.unroute("**/data/around?*")
    from_s, to_s = hour(site)
    page.evaluate("([from, to]) => stack.window(from, to)", [from_s - 60, to_s])
    # those were of another window
    assert page.evaluate("() => stack.now().traces[0].statistics") is None
    settle(page)
    expect(legend).to_contain_text("lost or damaged")
    expect(legend).not_to_contain_text("cannot tell")


def test_names_of_values_bools_and_texts_are_steps_with_names(page_as: PageAs, site: Site) -> None:
    page = page_as("viewer")
    open_plots(page, at(site, -50 * 60 * 10**9), at(site, -45 * 60 * 10**9), STATE, ENABLED, REMARK)
    page.evaluate("(time) => stack.cursorTo(time)", at(site, -50 * 60 * 10**9 + 5 * 10**9))
    for name, value in (("State", "DRIVING"), ("Enabled", "yes"), ("Remark", "turning")):
        expect(page.get_by_role("row", name=name)).to_contain_text(value)
    page.evaluate("([a, b]) => stack.window(a, b)", list(hour(site)))
    settle(page)
    drawn = now(page)["drawn"]
    assert (drawn["state"]["low"], drawn["state"]["high"]) == (0, 2)
    assert drawn["enabled"]["high"] == 1


def test_what_happened_stands_around_the_plots(page_as: PageAs, site: Site) -> None:
    page = page_as("operator", 390)
    begin, _ = hour(site)  # where the site takes long to fill, the alarm is later than that hour
    open_plots(page, begin, time.time(), SPEED, VOLTS, CHARGE)
    page.evaluate("() => stack.watch('ropod_001')")
    settle(page)
    page.get_by_text(re.compile(r"What happened in this window \(\d+\)")).click()
    happened = page.locator(".plot-list")
    for text in ("bumper pressed", hostile.MISSION, "transport: succeeded"):
        expect(happened).to_contain_text(text)
    expect(happened.get_by_role("link").first).to_be_visible()  # to the alarm
    flag = page.get_by_role("button", name=re.compile("bumper pressed")).first
    flag.focus()
    expect(flag.locator(".plot-tip")).to_be_visible()
    lane = page.get_by_role("group", name="States of laser_rear")
    expect(lane.get_by_role("img", name=re.compile("^warning"))).to_have_count(1)
    axe(page)
    no_sideways_scroll(page)
    shot(page, "plots")
    assert page.title() == "Plots"


def test_flags_keep_their_place_and_focus_while_plots_move(page_as: PageAs, site: Site) -> None:
    page = page_as("viewer")
    open_plots(page, *hour(site), SPEED)
    page.evaluate("() => stack.watch('ropod_001')")
    settle(page)
    flag = page.get_by_role("button", name=re.compile("bumper pressed")).first
    flag.focus()
    left = page.evaluate("() => document.activeElement.style.left")
    from_s, to_s = hour(site)
    page.evaluate("([from, to]) => stack.window(from, to)", [from_s - 600, to_s])
    settle(page)
    expect(flag).to_be_focused()
    assert page.evaluate("() => document.activeElement.style.left") != left


def test_live_values_are_appended_until_one_zooms(page_as: PageAs, site: Site) -> None:
    page = page_as("viewer")
    open_plots(page, at(site, -5 * 60 * 10**9), at(site, 0), SPEED)
    page.evaluate("""() => {
        window.wants = []; window.states = [];
        window.feed = { on: (kind, fn) => { window.tell = fn; }, want: (what) => wants.push(what) };
        stack.live(feed);
    }""")
    assert page.evaluate("() => wants") == [{"live": {ROBOT: [f"{ODOM}.twist_linear_x"]}}]

    def tell(after_s: float, value: float | None) -> None:
        stamp = datetime.fromtimestamp(at(site, 0) + after_s, UTC).isoformat()
        data = {f"{ODOM}.twist_linear_x": {"at": stamp, "value": value}}
        page.evaluate("([robot, data]) => tell(data, robot)", [ROBOT, data])

    asked: list[str] = []
    page.on("request", lambda request: asked.append(request.url))
    for number in range(20):
        tell(1 + number, None if number == 5 else 7.5)
    page.wait_for_function("() => stack.now().settled")
    assert now(page)["to"] == pytest.approx(at(site, 0) + 20, abs=0.01)
    assert now(page)["to"] - now(page)["from"] == pytest.approx(300, abs=0.01)
    assert not asked  # no question for each value
    page.evaluate("(time) => stack.cursorTo(time)", at(site, 0) + 15.5)
    expect(page.get_by_role("row", name="Speed")).to_contain_text("7.5")
    page.get_by_role("group", name="Plots over time").focus()
    page.keyboard.press("-")
    end = now(page)["to"]
    tell(30, 7.5)
    settle(page)
    assert now(page)["to"] == end  # it waits while somebody looks
    page.evaluate("() => stack.follow()")
    tell(31, 7.5)
    settle(page)
    assert now(page)["to"] == pytest.approx(at(site, 0) + 31, abs=0.01)


def test_two_missions_lie_over_each_other(page_as: PageAs, site: Site) -> None:
    page = page_as("viewer")
    origins = at(site, -50 * 60 * 10**9), at(site, -20 * 60 * 10**9)
    pose = SPEED | {"variable": "pose_x", "unit": "m", "panel": "one"}
    traces = [
        pose | {"id": f"m{n}", "label": f"Mission {n}", "origin": origin}
        for n, origin in enumerate(origins)
    ]
    open_plots(page, 0, 120, *traces, relative=True)
    page.evaluate("() => stack.cursorTo(65.5)")
    expect(page.locator(".plot-time")).to_have_text(re.compile(r"At 01:05\.5"))
    rows = [page.get_by_role("row", name=f"Mission {n}").get_by_role("cell").first for n in (0, 1)]
    values = [float(row.inner_text().replace("\u2212", "-")) for row in rows]
    began_s = record.BEGIN_NS / 1e9
    for value, origin in zip(values, (-50 * 60, -20 * 60), strict=True):
        assert value == pytest.approx(4 * math.cos((origin + 65.5 - began_s) / 30), abs=0.02)


def test_what_is_compared_ends_with_its_mission(page_as: PageAs, site: Site) -> None:
    page = page_as("viewer")
    origin = at(site, -50 * 60 * 10**9)
    voltage = VOLTS | {"panel": "one"}
    missions = [
        voltage | {"id": "done", "label": "Done", "origin": origin, "length": 30},
        voltage | {"id": "late", "label": "Late", "origin": at(site, 60 * 10**9), "length": 16},
        voltage | {"id": "long", "label": "Long", "origin": origin, "length": 120},
    ]
    open_plots(page, 0, 120, *missions, relative=True)
    last = page.evaluate("() => stack.now().traces.map(({ series }) => series.x.at(-1) ?? null)")
    assert last[0] <= 30 and last[1] is None and last[2] > 110
    expect(page.locator(".plot-key").nth(1)).to_contain_text("not on the server yet")
    page.evaluate("() => stack.cursorTo(60)")
    expect(page.get_by_role("row", name="Late")).not_to_contain_text("not on the server")
    page.evaluate("() => stack.cursorTo(8)")
    expect(page.get_by_role("row", name="Late")).to_contain_text("not on the server yet")
    expect(page.get_by_role("row", name="Done")).to_contain_text("15")  # rows of 30 s


def test_a_variable_goes_and_its_colour_is_free_again(page_as: PageAs, site: Site) -> None:
    page = page_as("viewer")
    open_plots(page, *hour(site), SPEED, VOLTS)
    page.get_by_role("button", name="Take Speed away").click()
    expect(page.locator(".plot-panel")).to_have_count(1)
    expect(page.get_by_role("row", name="Speed")).to_have_count(0)
    page.evaluate("(trace) => stack.add(trace)", CHARGE | {"panel": "other"})
    settle(page)
    colours = page.evaluate("() => stack.now().traces.map((trace) => trace.colour)")
    assert colours == [1, 0]


def test_a_variable_that_is_not_there_says_so(page_as: PageAs, site: Site) -> None:
    page = page_as("viewer", expects=["400", "404"])
    open_plots(page, *hour(site), SPEED | {"variable": hostile.MARKUP}, VOLTS)
    expect(page.locator(".plot-problem").first).to_contain_text("<img src=x")
    assert now(page)["drawn"]["volts"]["of"] > 1000


def test_the_colours_change_with_the_theme(page_as: PageAs, site: Site) -> None:
    page = page_as("viewer")
    open_plots(page, *hour(site), VOLTS)
    swatch = page.locator(".plot-swatch").first
    before = swatch.evaluate("(element) => getComputedStyle(element).backgroundColor")
    page.evaluate("() => { document.documentElement.dataset.theme = 'dark'; }")
    expect(swatch).not_to_have_css("background-color", before)


def test_one_against_the_other_and_how_often(page_as: PageAs, site: Site) -> None:
    page = page_as("viewer", theme="dark")
    open_plots(page, *hour(site))
    made = """async ([all, module, name, about]) => {
        const place = document.getElementById("place");
        window[name] = (await import(all)).$need(module)[name](place, about);
        await window[name].ready;
    }"""
    whole = address("all.js")
    span = {"from": at(site, -50 * 60 * 10**9), "to": at(site, -40 * 60 * 10**9)}
    pose = [SPEED | {"variable": f"pose_{axis}", "label": axis, "unit": "m"} for axis in "xy"]
    page.evaluate(made, [whole, "plot/figures.js", "xyView", {"x": pose[0], "y": pose[1], **span}])
    expect(page.get_by_role("img", name="y [m] against x [m]")).to_be_visible()
    expect(page.get_by_text(re.compile(r"points out of 30,000"))).to_be_visible()
    page.evaluate(made, [whole, "plot/figures.js", "histogram", {"trace": STATE, **span}])
    expect(page.get_by_text("300 values")).to_be_visible()
    table = page.get_by_role("table", name="How often State had which value")
    counts = {name: int(table.get_by_role("row", name=name).get_by_role("cell").inner_text())
              for name in ("IDLE", "DRIVING", "BLOCKED")}  # fmt: skip
    assert counts == {"IDLE": 105, "DRIVING": 105, "BLOCKED": 90}


def test_an_older_answer_never_covers_a_newer_one(page_as: PageAs, site: Site) -> None:
    page = page_as("viewer")
    open_plots(page, *hour(site), VOLTS)
    held: list[Route] = []
    page.route("**/query?*", lambda route: held.append(route))
    end = hour(site)[1]
    for minutes in (40, 30, 20):
        page.evaluate("([from, to]) => stack.window(from, to)", [end - minutes * 60, end])
    _until(page, held, 1)
    assert len(held) == 1  # one at a time
    held[0].continue_()
    _until(page, held, 2)
    assert f"from={end - 20 * 60 - 24:.6f}" in held[1].request.url  # 2 % more at each side
    held[1].continue_()
    settle(page)
    assert len(held) == 2
    assert now(page)["drawn"]["volts"]["of"] <= 20 * 30 * 1.1


def _until(page: Page, held: list[Route], number: int) -> None:
    end_s = time.monotonic() + PATIENCE_S
    while len(held) < number:
        assert time.monotonic() < end_s
        page.wait_for_timeout(20)
