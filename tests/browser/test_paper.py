"""Paper: in light colours whatever the theme is, with nothing cut off."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from playwright.sync_api import expect

import amberbox.sim
from amberbox.experiments.bpmn import read_bpmn
from amberbox.experiments.drawing import draw_bpmn
from tests.browser.conftest import PageAs
from tests.browser.hostile import EARLIER_RUN, RUN

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

EXPERIMENT = Path(amberbox.sim.__file__).parent / "folder/experiments/cart_transport.bpmn"
A4_PX = 718  # a page of 210 mm with margins of 10 mm, in pixels
INK = "rgb(31, 34, 38)"
_CUT = """() => [...document.querySelectorAll("main *")].filter((one) =>
    one.checkVisibility() && one.clientWidth && getComputedStyle(one).overflowX !== "visible"
    && one.scrollWidth > one.clientWidth + 1
    && !one.matches(".clip, .clip *, .sr-only, thead, input")
).map((one) => `${one.tagName} ${one.className} ${one.textContent.trim().slice(0, 40)}`)"""


def on_paper(page: Page, width: int = A4_PX) -> None:
    """Lay a page out as for printing, in the dark setting of the screen."""
    page.set_viewport_size({"width": width, "height": 1000})
    page.emulate_media(media="print", color_scheme="dark")
    page.evaluate("dispatchEvent(new Event('beforeprint'))")


@pytest.mark.parametrize("path", [
    f"/runs/{RUN}", "/robots/ropod_001", "/robots/ropod_001/diagnosis?details=1&tab=tree",
    "/robots/ropod_002/experiments/wheel_check",
])  # fmt: skip
def test_pages_are_printed_light_and_whole(page_as: PageAs, path: str) -> None:
    page = page_as("technician", theme="dark")
    page.goto(path)
    if "tree" in path or path == "/robots/ropod_001":
        page.locator(".drawing.graph, .drawing.faulttree").first.wait_for()
    on_paper(page)
    expect(page.locator("body")).to_have_css("color", INK)
    expect(page.locator("html")).to_have_css("background-color", "rgb(255, 255, 255)")
    assert page.evaluate(_CUT) == []
    expect(page.locator("main textarea").locator("visible=true")).to_have_count(0)


def test_a_plot_is_printed_light(page_as: PageAs) -> None:
    page = page_as("viewer", theme="dark")
    page.goto("/robots/ropod_001/data?v=battery.volts")
    swatch = page.locator(".plot-readout .plot-swatch").first
    dark = "rgb(100, 168, 245)"
    expect(swatch).to_have_css("background-color", dark)
    on_paper(page)
    expect(swatch).to_have_css("background-color", "rgb(11, 101, 194)")
    page.emulate_media(media="screen")
    page.evaluate("dispatchEvent(new Event('afterprint'))")
    expect(swatch).to_have_css("background-color", dark)


def test_a_report_is_printed_light_and_whole(page_as: PageAs) -> None:
    page = page_as("viewer", theme="dark")
    page.goto(f"/runs/{EARLIER_RUN}/report")
    expect(page.locator("body")).to_have_css("background-color", "rgb(22, 25, 29)")
    on_paper(page)
    expect(page.locator("body")).to_have_css("background-color", "rgb(255, 255, 255)")
    expect(page.locator(".bpmn")).to_have_css("background-color", "rgb(255, 255, 255)")
    assert page.evaluate("() => document.documentElement.scrollWidth") <= A4_PX
    assert page.evaluate(_CUT) == []


def test_a_drawing_fills_one_page_in_landscape_format(browser: Browser, tmp_path: Path) -> None:
    problems: list[object] = []
    model = read_bpmn(EXPERIMENT, problems)  # type: ignore[arg-type]  # only counted
    assert model is not None and not problems
    drawing = tmp_path / "cart.svg"
    drawing.write_text(str(draw_bpmn(model)), encoding="utf-8")
    context = browser.new_context(color_scheme="dark")
    try:
        page = context.new_page()
        page.goto(drawing.as_uri())
        data = page.pdf(format="A4", prefer_css_page_size=True)
        assert len(re.findall(rb"/Type\s*/Page\b", data)) == 1
        page.emulate_media(media="print", color_scheme="dark")
        page.set_viewport_size({"width": A4_PX, "height": 1000})
        box = page.locator("svg").bounding_box()
        assert box is not None and box["width"] <= A4_PX
        expect(page.locator("svg")).to_have_css("background-color", "rgb(255, 255, 255)")
    finally:
        context.close()
