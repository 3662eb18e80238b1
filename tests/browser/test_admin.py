"""Accounts, people, teams and robots, in a browser."""

from playwright.sync_api import expect

from tests.browser.conftest import PageAs
from tests.browser.page_checks import axe, shot
from tests.browser.site import Site
from tests.server.alarms.receivers import hook_server


def test_somebody_is_invited_and_chooses_a_password(page_as: PageAs) -> None:
    page = page_as("admin")
    page.goto("/admin/users")
    page.get_by_text("Invite somebody").first.click()
    page.get_by_label("Name", exact=False).first.fill("berta")
    page.locator("#invite").get_by_label("All robots").check()
    page.locator("#invite button").click()
    password = page.get_by_role("dialog").locator("textarea").input_value()
    page.get_by_role("button", name="I have put it away").click()
    expect(page.get_by_role("cell", name="berta")).to_be_visible()

    other = page_as("")
    other.goto("/knowledge")
    other.get_by_label("Name").fill("berta")
    other.get_by_label("Password").fill(password)
    other.get_by_role("button", name="Sign in").click()
    other.get_by_label("Password as it is").fill(password)
    other.locator("[name=new]").fill("one long enough for me")
    other.get_by_label("New password again").fill("one long enough for me")
    other.get_by_role("button", name="Change the password").click()
    expect(other.get_by_role("heading", name="Robots", exact=True)).to_be_visible()


def test_a_robot_is_added_and_its_line_shown_once(page_as: PageAs) -> None:
    page = page_as("admin")
    page.goto("/admin/robots")
    page.get_by_text("Add a robot").first.click()
    page.get_by_label("Name of the robot").fill("ropod_009")
    page.locator("#add button").click()
    line = page.get_by_role("dialog").locator("textarea").input_value()
    assert "ropod_009" in line
    page.get_by_role("button", name="I have put it away").click()
    row = page.get_by_role("row").filter(has_text="ropod_009")
    expect(row).to_contain_text("never connected")
    row.get_by_role("button", name="Change").click()
    page.get_by_role("button", name="Switch off").click()
    page.get_by_role("dialog").get_by_role("button", name="Yes").click()
    expect(row).to_contain_text("switched off")


def test_a_token_is_made_and_revoked(page_as: PageAs) -> None:
    page = page_as("technician")
    page.goto("/account")
    page.get_by_text("Make a token").first.click()
    page.get_by_label("What for").fill("wall board")
    page.locator("#new-token form button").click()
    assert page.get_by_role("dialog").locator("textarea").input_value()
    page.get_by_role("button", name="I have put it away").click()
    expect(page.get_by_role("cell", name="wall board")).to_be_visible()
    page.get_by_role("button", name="Revoke").click()
    page.get_by_role("dialog").get_by_role("button", name="Yes").click()
    expect(page.get_by_text("You have no token.")).to_be_visible()


def test_an_admin_revokes_a_token_of_somebody(page_as: PageAs, site: Site) -> None:
    secret = site.token("operator", "read:status")
    prefix = "_".join(secret.split("_")[:2])
    page = page_as("admin")
    page.goto("/admin/users")
    row = page.locator("tr", has=page.locator("b", has_text="operator"))
    row.get_by_role("button", name="Change").click()
    dialog = page.get_by_role("dialog")
    expect(dialog.get_by_text(prefix)).to_be_visible()
    axe(page)
    shot(page, "admin-tokens")
    dialog.get_by_role("button", name="Revoke", exact=True).click()
    page.get_by_role("dialog").get_by_role("button", name="Yes").click()
    expect(page.get_by_text(prefix)).to_have_count(0)
    assert all(one["revoked"] for one in site.ask("/users/operator/tokens"))


def test_a_setting_is_changed_and_mistakes_lose_nothing(page_as: PageAs) -> None:
    page = page_as("admin", expects=["400"])
    page.goto("/admin/settings/retention")
    page.get_by_role("button", name="Add").click()
    page.get_by_label("Class of recordings").fill("bulk")
    page.get_by_label("Recordings go after a time").check()
    page.locator(".duration input").first.fill("30")
    page.locator(".duration select").first.select_option("d")
    page.locator(".entry").get_by_label("Robot").first.fill("no robot!")
    page.get_by_role("button", name="Save").click()
    expect(page.get_by_role("alert").filter(has_text="no robot!")).to_be_visible()
    expect(page.get_by_label("Class of recordings")).to_have_value("bulk")
    page.locator(".entry").get_by_label("Robot").first.fill("*")
    page.get_by_role("button", name="Save").click()
    expect(page.get_by_text("Saved")).to_be_visible()
    page.reload()
    expect(page.locator(".duration input").first).to_have_value("30")
    expect(page.locator(".duration select").first).to_have_value("d")
    page.get_by_role("button", name="Remove").click()
    page.get_by_role("button", name="Save").click()
    expect(page.get_by_text("Saved")).to_be_visible()


def test_the_audit_log_is_followed(page_as: PageAs) -> None:
    page = page_as("admin")
    page.goto("/admin/audit?action=settings.change")
    page.get_by_role("button", name="Does it hold?").click()
    expect(page.get_by_text("It holds:")).to_be_visible()


def test_rows_are_cards_where_there_is_no_room(page_as: PageAs) -> None:
    page = page_as("admin", width=390)
    page.goto("/admin/users")
    row = page.get_by_role("row").filter(has_text="nurse")
    change = row.get_by_text("Change", exact=True)
    expect(change).to_be_visible()
    shown = change.bounding_box()
    assert shown and shown["x"] + shown["width"] <= 390, "the last column is off to the right"
    role = row.get_by_role("cell", name="technician").first
    assert role.evaluate("one => getComputedStyle(one, '::before').content") == '"Role"'
    page.set_viewport_size({"width": 1440, "height": 900})
    assert role.evaluate("one => getComputedStyle(one, '::before').content") == "none"


def test_all_robots_are_given_by_choosing_them_and_by_nothing_else(
    page_as: PageAs, site: Site
) -> None:
    page = page_as("admin")
    page.goto("/admin/users")
    page.get_by_text("Invite somebody").first.click()
    page.get_by_label("Name", exact=False).first.fill("carla")
    page.locator("#invite button").click()
    every = page.locator("#invite").get_by_label("All robots, also those to come")
    assert every.evaluate("one => one.validationMessage").startswith("Choose all robots")
    page.locator("#invite").get_by_label("kitchen").check()
    page.locator("#invite button").click()
    page.get_by_role("button", name="I have put it away").click()
    row = page.locator("tr", has=page.locator("b", has_text="carla"))
    expect(row).to_contain_text("kitchen")
    assert site.ask("/users/carla")["groups"] == ["kitchen"]

    row.get_by_role("button", name="Change").click()
    every = page.get_by_role("dialog").get_by_label("All robots, also those to come")
    every.check()
    expect(page.get_by_role("dialog").get_by_label("kitchen")).to_be_disabled()
    axe(page)
    shot(page, "admin-change")
    page.get_by_role("dialog").get_by_role("button", name="Save").click()
    expect(row).to_contain_text("all robots")
    assert site.ask("/users/carla")["groups"] is None


def test_a_destination_is_tried_and_its_answer_shown(page_as: PageAs, site: Site) -> None:
    page = page_as("admin")
    page.goto("/admin/settings/notifications")
    expect(page.get_by_text("Nobody is told yet.")).to_be_visible()
    with hook_server() as hook:
        page.get_by_role("group", name="By webhook").get_by_role("button", name="Add").click()
        entry = page.locator(".entry")
        expect(entry.get_by_text("One is stored:")).to_have_count(0)
        entry.get_by_role("textbox", name="Name", exact=True).fill("pager")
        entry.get_by_label("Address").fill(hook.url)
        entry.get_by_label("Secret").fill("0123456789abcdef")
        entry.get_by_label("when it is resolved").check()
        page.get_by_role("button", name="Save").click()
        row = page.locator("[data-destinations] li")
        expect(row).to_contain_text("pager by webhook to 127.0.0.1")
        expect(entry.get_by_text("One is stored:")).to_be_visible()

        expect(entry.get_by_label("when it is resolved")).to_be_checked()
        (saved,) = site.ask("/settings/notifications")["value"]["webhooks"]
        assert saved["also"] == ["resolved"]

        row.get_by_role("button", name="Send a test message").click()
        expect(row).to_contain_text("Taken by the receiver at")
        assert b'"type": "test"' in hook.bodies[0]
        hook.status = 503
        row.get_by_role("button", name="Send a test message").click()
        expect(row.get_by_role("alert")).to_contain_text("the answer was 503")
        axe(page)
        shot(page, "admin-notifications")
    tried = [one["object"] for one in site.ask("/audit?action=notifications.test")]
    assert tried == ["pager", "pager"]
    page.locator(".entry").get_by_role("button", name="Remove").click()
    page.get_by_role("button", name="Save").click()
    expect(page.get_by_text("Nobody is told yet.")).to_be_visible()
