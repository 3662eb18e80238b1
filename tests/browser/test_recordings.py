"""The pages about recordings in a browser: coverage, missions, incidents, files, downloads."""

import re
from pathlib import Path

from playwright.sync_api import expect

from amberbox.core.safe_text import escape_hidden
from tests.browser import hostile
from tests.browser.conftest import PageAs
from tests.browser.page_checks import axe, judge, no_sideways_scroll, shot
from tests.browser.site import Site

ROBOT = "/recordings/ropod_001"
_POST = """async ([path, body]) => (await fetch(path, {method: 'POST', body: JSON.stringify(body),
  headers: {'Content-Type': 'application/json',
            'X-CSRF-Token': document.querySelector('meta[name=csrf]').content}})).json()"""


def test_what_there_is_of_all_robots(page_as: PageAs) -> None:
    page = page_as("viewer", width=390)
    page.goto("/recordings?window=24h")
    for n in range(3):  # on a phone they are not in sight together
        card = page.locator("article.recording").nth(n)
        card.scroll_into_view_if_needed()
        expect(card.locator(".cover .drawing")).to_be_visible()
    expect(page.locator('[data-robot="ropod_001"]')).to_contain_text("3 missions")
    away = page.locator('[data-robot="ropod_003"]')
    expect(away).to_contain_text("offline, last seen")
    expect(away).to_contain_text("1,234 rows (56 MB) still on the robot")
    judge(page, "recordings")


def test_only_robots_that_one_sees_are_asked_for(page_as: PageAs) -> None:
    page = page_as("viewer", width=390)
    page.set_viewport_size({"width": 390, "height": 200})
    asked: list[str] = []
    page.on("request", lambda request: asked.append(request.url))
    page.goto("/recordings?window=24h")
    expect(page.locator('[data-robot="ropod_001"] .cover .drawing')).to_be_visible()
    with page.expect_request(lambda request: "/pieces/recordings?robot=ropod_001" in request.url):
        page.evaluate("() => document.dispatchEvent(new Event('visibilitychange'))")
    assert not [url for url in asked if "ropod_003" in url]
    last = page.locator('[data-robot="ropod_003"]')
    last.scroll_into_view_if_needed()
    expect(last.locator(".cover .drawing")).to_be_visible()


def test_the_recordings_of_one_robot(page_as: PageAs) -> None:
    page = page_as("technician")
    page.goto(f"{ROBOT}?window=24h")
    expect(page.locator(".cover .drawing")).to_be_visible()
    expect(page.locator("#missions tbody tr")).not_to_have_count(0)
    expect(page.get_by_role("link", name=hostile.MISSION)).to_be_visible()
    page.get_by_text("Mark an incident").click()
    expect(page.locator("#mark-incident input[name=from]")).not_to_have_value("")
    judge(page, "recordings-robot", [("dark", 1440), ("light", 390)])


def test_missions_are_chosen_compared_and_downloaded(page_as: PageAs) -> None:
    page = page_as("technician")
    page.goto(ROBOT)
    boxes = page.locator('input[form="chosen"]')
    compare = page.get_by_role("button", name="Compare")
    boxes.nth(1).focus()
    page.keyboard.press("Space")
    expect(compare).to_be_disabled()
    boxes.nth(2).check()
    expect(page.get_by_text("2 chosen")).to_be_visible()
    expect(compare).to_be_enabled()
    page.get_by_role("button", name="Download", exact=True).click()
    expect(page).to_have_url(re.compile(r"/downloads\?mission=.+&mission=.+&robot=ropod_001"))
    expect(page.get_by_role("checkbox", name="ropod_001")).to_be_checked()
    expect(page.locator('[data-chips="missions"] [aria-pressed="true"]')).to_have_count(2)


def test_a_note_is_kept_and_what_is_chosen_stays(page_as: PageAs) -> None:
    page = page_as("operator")
    page.goto(ROBOT)
    box = page.locator('input[form="chosen"]').first
    box.check()
    row = page.locator("#missions tbody tr").first
    row.get_by_text("Add one").or_(row.get_by_text(re.compile("notes?$"))).first.click()
    row.get_by_role("textbox").fill(hostile.NOTE)
    row.get_by_role("button", name="Keep the note").click()
    expect(row.locator(".recordings-notes p").first).to_have_text(escape_hidden(hostile.NOTE))
    expect(box).to_be_checked()
    expect(row.get_by_role("textbox")).to_have_value("")


def test_an_incident_is_marked_and_released(page_as: PageAs) -> None:
    page = page_as("operator")
    page.goto(ROBOT)
    page.get_by_text("Mark an incident").click()
    page.get_by_label("Why it is kept").fill(hostile.MARKUP)
    page.get_by_role("button", name="Mark it").click()
    row = page.locator("#incidents tr", has_text=hostile.MARKUP)
    expect(row).to_contain_text("kept")
    row.get_by_role("button", name="Release").click()
    page.get_by_role("button", name="Yes").click()
    expect(row).to_contain_text("released")


def test_what_others_do_appears_by_itself(page_as: PageAs) -> None:
    page, other = page_as("viewer"), page_as("operator")
    page.goto("/recordings/ropod_002")
    other.goto("/recordings/ropod_002")
    incidents = page.locator("#incidents")
    expect(incidents).to_be_visible()
    expect(incidents).not_to_contain_text("it smells burnt")
    window = {"from": "now-5m", "to": "now", "reason": "it smells burnt"}
    posted = other.evaluate(_POST, ["/api/v1/robots/ropod_002/incidents", window])
    page.evaluate("() => document.dispatchEvent(new Event('visibilitychange'))")  # not in 10 s: now
    expect(incidents).to_contain_text("it smells burnt")
    other.evaluate(_POST, [f"/api/v1/robots/ropod_002/incidents/{posted['id']}/release", {}])
    page.evaluate("() => document.dispatchEvent(new Event('visibilitychange'))")
    expect(page.locator("#incidents")).to_contain_text("released")


def test_what_is_asked_of_a_robot_is_told_at_once(page_as: PageAs) -> None:
    page, other = page_as("viewer"), page_as("technician")
    page.goto("/recordings/ropod_003")
    other.goto("/recordings/ropod_003")
    expect(page.locator("html")).to_have_attribute("data-feed", "live")
    window = {"item": "odom", "from": "now-50m", "to": "now-40m"}
    asked = other.evaluate(_POST, ["/api/v1/robots/ropod_003/fetches", window])
    expect(page.locator(f"#fetch-{asked['id']}")).to_contain_text("odom")


def test_a_mission_is_begun_and_ended(page_as: PageAs) -> None:
    page = page_as("operator")
    page.goto("/recordings/ropod_002")
    page.get_by_text("Begin a mission").click()
    page.get_by_label("Name").fill("test-drive")
    page.get_by_role("button", name="Begin", exact=True).click()
    row = page.locator("#missions tr", has_text="test-drive").first
    row.get_by_role("combobox").select_option("aborted")
    row.get_by_role("button", name="End the mission").click()
    expect(row).to_contain_text("aborted")


def test_the_robot_is_asked_for_data_and_that_is_cancelled(page_as: PageAs) -> None:
    page = page_as("technician")
    page.goto("/recordings/ropod_003")
    rows = page.locator("#fetches tbody tr")
    before = rows.count()
    page.get_by_text("Ask the robot for data").click()
    page.get_by_role("button", name="Ask", exact=True).click()
    expect(rows).to_have_count(before + 1)  # what others asked for stands there, too
    row = rows.first
    expect(row).to_contain_text("waits for the robot")
    row.get_by_role("button", name="Cancel").click()
    page.get_by_role("button", name="Yes").click()
    expect(row).to_contain_text("not wanted any more")


def test_files_are_checked_anew(page_as: PageAs, site: Site) -> None:
    page = page_as("viewer")
    page.goto(ROBOT)
    page.get_by_role("button", name="Check now").click()
    expect(page.locator("#check")).to_contain_text("all of them are as they came")
    listed = site.ask("/robots/ropod_001/recordings")[0]
    path = site.data / "journals" / "ropod_001" / listed["store_id"] / listed["journal"]
    whole = path.read_bytes()
    try:
        path.write_bytes(bytes([whole[0] ^ 1]) + whole[1:])  # of the same size: only its hash tells
        page.get_by_role("button", name="Check now").click()
        expect(page.locator("#check")).to_contain_text("1 of them are not as they came")
        expect(page.locator("#check li")).to_contain_text(listed["journal"])
        expect(page.locator("tr.is-altered")).to_contain_text("altered")
    finally:
        path.write_bytes(whole)


def test_a_download_is_made_fetched_and_deleted(page_as: PageAs, tmp_path: Path) -> None:
    page = page_as("technician")
    page.goto("/downloads?robot=ropod_001#new")
    page.locator('[data-chips="items"]').get_by_role("button", name="battery").click()
    page.get_by_label(re.compile("^MCAP")).focus()
    page.keyboard.press("ArrowLeft")
    expect(page.get_by_label(re.compile("^Parquet"))).to_be_checked()
    page.get_by_role("button", name="Make it").click()
    job = page.locator(".download").first
    expect(job).to_have_attribute("data-state", "done")
    expect(job).to_contain_text("missions: the last one")
    with page.expect_download() as taken:
        job.get_by_role("link", name="Download").click()
    taken.value.save_as(tmp_path / "file")
    assert (tmp_path / "file").stat().st_size > 100
    axe(page)
    shot(page, "downloads")
    job.get_by_role("button", name="Delete").click()
    page.get_by_role("button", name="Yes").click()
    expect(job).to_have_attribute("data-state", "expired")
    job.get_by_role("link", name="Ask again").click()
    expect(page.locator('[data-chips="items"] [aria-pressed="true"]')).to_have_text("battery")


def test_what_is_missing_in_the_form_is_said_beside_it(page_as: PageAs) -> None:
    page = page_as("technician", width=390)
    page.goto("/downloads")
    page.locator("#new").evaluate("details => details.open = true")
    page.get_by_role("button", name="Make it").click()
    expect(page.get_by_role("alert").filter(has_text="Choose a robot.")).to_be_visible()
    no_sideways_scroll(page)


def test_a_download_of_somebody_else_is_not_shown(page_as: PageAs, site: Site) -> None:
    page = page_as("nurse")
    page.goto("/downloads")
    body = {"robots": ["ropod_001"], "from": "now-1h", "to": "now", "format": "csv"}
    mine = page.evaluate(_POST, ["/api/v1/downloads", body])
    expect(page.locator(f'[data-job="{mine["id"]}"]')).to_be_visible()  # the feed told of it
    assert mine["id"] not in [one["id"] for one in site.ask("/downloads", "technician")]
