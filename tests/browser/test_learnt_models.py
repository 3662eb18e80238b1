"""The page of learnt detectors in a browser: learn one, see its promise, fetch, delete."""

import re
from pathlib import Path

from playwright.sync_api import expect

from amberbox.detection.model_file import load_model
from tests.browser.conftest import PageAs
from tests.browser.page_checks import judge


def test_a_model_is_learnt_fetched_and_deleted(page_as: PageAs, tmp_path: Path) -> None:
    page = page_as("technician", width=390)
    page.goto("/models?robot=ropod_001")  # as it was called before
    expect(page).to_have_url(re.compile(r"/detectors\?robot=ropod_001$"))
    expect(page.get_by_role("checkbox", name="ropod_001")).to_be_checked()
    judge(page, "models-form")
    page.get_by_label(re.compile("^As a team")).check()
    expect(page.get_by_label(re.compile("^state_flow"))).to_be_checked()
    page.get_by_label(re.compile("^As a team")).uncheck()
    for name in ("event_timing", "guard", "state_flow"):
        page.get_by_label(re.compile(f"^{name}")).uncheck()
    page.get_by_role("button", name="Learn it").click()
    expect(page.get_by_role("alert").filter(has_text="Choose a detector.")).to_be_visible()
    page.get_by_label(re.compile("^guard")).check()
    page.get_by_label("Name", exact=False).last.fill("night")
    page.get_by_label("Missions by name").fill("nowhere")
    page.get_by_role("button", name="Learn it").click()
    job = page.locator(".download").first
    expect(job).to_have_attribute("data-state", "failed")
    expect(job).to_contain_text("there is no mission 'nowhere'")
    page.get_by_text("Learn detectors").click()
    page.get_by_label("Missions by name").fill("")
    page.get_by_role("button", name="Learn it").click()
    expect(job).to_contain_text("night version 2")
    expect(job).to_have_attribute("data-state", "done")
    job.get_by_text("What it promises").click()
    expect(job).to_contain_text("asked for 1 false alarm per hour")
    judge(page, "models")
    with page.expect_download() as taken:
        job.get_by_role("link", name="Download").click()
    taken.value.save_as(tmp_path / "night.model")
    assert set(load_model(tmp_path / "night.model").detectors) == {"guard"}
    job.get_by_role("button", name="Delete").click()
    page.get_by_role("button", name="Yes").click()
    expect(job).not_to_contain_text("version 2")


def test_who_only_looks_sees_models_and_no_form(page_as: PageAs) -> None:
    page = page_as("viewer")
    page.goto("/detectors")
    expect(page.get_by_role("heading", name="Learnt detectors")).to_be_visible()
    expect(page.locator("#new")).to_have_count(0)
