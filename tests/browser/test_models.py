"""The pages of a robot's models in a browser."""

from __future__ import annotations

import pytest
from playwright.sync_api import expect

from tests.browser.conftest import PageAs
from tests.browser.page_checks import LOOKS, Look, axe, look, no_sideways_scroll, shot

WALL: Look = ("dark", 3840)


def test_from_the_diagnosis_to_a_model(page_as: PageAs) -> None:
    page = page_as("viewer")
    page.goto("/robots/ropod_001/diagnosis?details=1&tab=tree")
    page.get_by_role("tab", name="Fault tree").press("ArrowRight")
    page.get_by_role("link", name="power").press("Enter")
    expect(page.get_by_role("heading", name="Which faults agree with it")).to_be_visible()
    expect(page.locator("svg .node")).to_have_count(3)
    page.get_by_label("component.port=value").fill("main.out=on")
    page.get_by_label("component.port=value").press("Enter")
    expect(page.get_by_role("cell", name="arm=tripped", exact=True)).to_be_visible()
    expect(page.locator("svg .level-error.node")).to_have_attribute("data-id", "arm")
    page.get_by_role("link", name="Without main.out=on").press("Enter")
    expect(page.get_by_role("cell", name="main=tripped", exact=True)).to_be_visible()
    page.get_by_role("link", name="All robot models").click()
    expect(page.get_by_role("link", name="large")).to_be_visible()


def test_a_large_structure_is_looked_through(page_as: PageAs) -> None:
    page = page_as("viewer")
    page.goto("/robots/ropod_001/models/large")
    rows = page.locator(".cells tbody tr")
    expect(rows).to_have_count(94)
    last = rows.last.get_by_role("rowheader")
    page.get_by_role("region", name="Which unknowns").focus()
    page.keyboard.press("End")
    expect(last).to_be_in_viewport()
    page.get_by_role("searchbox").fill("equation_17")
    page.get_by_role("searchbox").press("Enter")
    expect(rows).to_have_count(1)
    page.get_by_role("link", name="Faults", exact=True).press("Enter")
    expect(page.locator(".cells tbody tr")).to_have_count(32)
    page.get_by_role("link", name="Tests").press("Enter")
    expect(page.locator(".model-sets li").first).to_be_visible()


def test_residuals_are_drawn_over_the_record(page_as: PageAs) -> None:
    page = page_as("viewer")
    page.goto("/robots/ropod_001/models/motion")
    with page.expect_response("**/residual?*") as answered:
        page.get_by_role("link", name="Residuals", exact=True).press("Enter")
    sizes = [size for size in answered.value.json()["sizes"] if size is not None]
    assert 0.55 < max(sizes) < 0.7 and min(sizes) > 0.3, "0.5 m/s with a swing of 0.1 m/s"
    rows = page.locator(".model-list tbody tr")
    expect(rows).to_have_count(2)
    expect(rows.first).to_contain_text("odometry")
    expect(rows.first).to_contain_text("0.55")
    expect(page.locator("#residual-plots canvas")).to_have_count(1)  # the other cannot be computed
    drawn = page.locator("#residual-plots")
    expect(drawn.get_by_role("group").get_by_text("threshold", exact=True)).to_be_visible()
    swatches = drawn.locator(".plot-readout .plot-swatch")
    size, above, below = swatches.evaluate_all("(all) => all.map((one) => one.style.background)")
    assert size != above == below, "thresholds have a colour of their own"
    expect(drawn.get_by_role("columnheader", name="Drawn")).to_be_visible()
    expect(drawn.get_by_role("columnheader", name="Mean")).to_have_count(0)  # there are none
    for theme, width in LOOKS:
        with look(page, theme, width):
            no_sideways_scroll(page)
            shot(page, "model-residuals")
    axe(page)


def test_the_chosen_tab_is_in_sight_on_a_phone(page_as: PageAs) -> None:
    page = page_as("viewer", 390)
    page.goto("/robots/ropod_001/models/motion?show=residuals")
    chosen = page.get_by_role("link", name="Residuals", exact=True)
    expect(chosen).to_have_attribute("aria-current", "page")
    expect(chosen).to_be_in_viewport(ratio=0.95)


@pytest.mark.parametrize("path", ["large?q=equation_1", "power", "odd?show=faults"])
def test_looks(page_as: PageAs, path: str) -> None:
    page = page_as("viewer")
    page.goto(f"/robots/ropod_001/models/{path}")
    for theme, width in (*LOOKS, WALL):
        with look(page, theme, width):
            no_sideways_scroll(page)
            shot(page, f"model-{path.replace('?', '-')}", whole=False)
    axe(page)
    assert not page.title().startswith("1"), "a text of somebody has run as a script"
