"""An experiment with two people: a technician at a desk, an operator with a phone at the robot.

Server, link and command process are real, and so is the simulated robot that drives.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from playwright.sync_api import expect

import amberbox.sim
from amberbox.client import credentials, signing_key
from amberbox.server.accounts.sessions import begin_session
from amberbox.server.accounts.users import find_user
from amberbox.server.database import FILE, ServerDatabase
from amberbox.server.http.auth import COOKIE
from tests.browser.conftest import PageAs
from tests.browser.page_checks import EVERY_LOOK, RESTART, judge
from tests.support.commanded import ROBOT, Commanded, commanded, simulated_robot
from tests.support.commands import ANNA
from tests.support.processes import wait_for, wait_for_listener

if TYPE_CHECKING:
    from playwright.sync_api import Locator, Page

PHONE = 390
SAMPLES = Path(amberbox.sim.__file__).parent / "folder"
HOSTILE = "</title><script>document.title='1'</script>\u202e<img src=x onerror=alert(1)>"


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Commanded]:
    folder = tmp_path_factory.mktemp("world")
    samples = (SAMPLES / "experiments").glob("*.bpmn")
    files = {f"experiments/{path.name}": path.read_text() for path in samples}
    with simulated_robot(folder) as endpoint:
        actions = (SAMPLES / "actions" / "sim.yaml").read_text()
        actions = re.sub(r"tcp://127\.0\.0\.1:5557", endpoint, actions)
        with commanded(folder, endpoint, actions, files=files) as found:
            with found.fleet() as fleet:
                wait_for(lambda: fleet.experiments(ROBOT), "the robot's experiments")
            yield found


@contextmanager
def signing(world: Commanded, folder: Path, run: str) -> Iterator[None]:
    """Let Anna's computer sign what waits for it in a run."""
    home = {"XDG_CONFIG_HOME": str(folder / "config"), credentials.VARIABLE: world.tokens["anna"]}
    words = ("sign", world.where, "--run", run, "--yes-to", "drive_linear")
    with (folder / "sign.log").open("wb") as log:
        process = subprocess.Popen(
            [sys.executable, "-m", "amberbox", *words], env={**os.environ, **home},
            stdin=subprocess.DEVNULL, stdout=log, stderr=log,
        )  # fmt: skip
    try:
        yield
    finally:
        process.terminate()
        process.wait()


@pytest.fixture
def annas_key(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patched:
        patched.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
        patched.setattr("amberbox.core.ed25519.new_private_key", lambda: ANNA.private)
        signing_key.make_key("anna")


@pytest.fixture(autouse=True)
def nothing_runs(world: Commanded) -> Iterator[None]:
    yield
    with world.fleet() as fleet:
        for run in fleet.runs(ROBOT):
            if not run.is_over:
                fleet.abort_run(ROBOT, run.id)
        wait_for(lambda: not fleet.actions(ROBOT).lease.holder, "a free robot")


def opened(
    page_as: PageAs, world: Commanded, name: str, path: str, width: int = 1440, *,
    expects: Sequence[str] = (), **options: Any,
) -> Page:  # fmt: skip
    """Open a page of the world's server as a person."""
    page = page_as("", width, at=world.url, expects=expects, **options)
    database = ServerDatabase(world.data / FILE)
    with database.begin() as connection:
        user = find_user(connection, name)
        began = begin_session(connection, time.time_ns(), user.user_id, "127.0.0.1", "tests")
    database.close()
    page.context.add_cookies([{"name": COOKIE, "value": began.secret, "url": world.url}])
    page.goto(path)
    return page


def started(page: Page) -> str:
    """Start the wheel check from its page; return the id of the run."""
    page.get_by_label("distance_m").fill("-0.3")
    page.get_by_label("I have read this.").check()
    page.get_by_role("button", name="Start").click()
    page.wait_for_url("**/runs/r-*")
    return page.url.rpartition("/")[2]


@pytest.mark.usefixtures("annas_key")
def test_two_people_run_an_experiment(page_as: PageAs, world: Commanded, tmp_path: Path) -> None:
    desk = opened(page_as, world, "anna", f"/robots/{ROBOT}/experiments")
    phone = opened(page_as, world, "olga", "/tasks", PHONE, has_touch=True, is_mobile=True)
    expect(phone.get_by_text("There is nothing to do.")).to_be_visible()
    judge(desk, "robot-experiments", EVERY_LOOK)
    desk.get_by_role("link", name="Wheel check").click()
    judge(desk, "start", EVERY_LOOK)
    run = started(desk)
    expect(phone.get_by_role("heading", name="Confirm that the path is clear")).to_be_visible()
    expect(phone.get_by_text("Step 1 of")).to_be_visible()
    expect(phone.locator("#run-news")).to_contain_text("Your step: Confirm that the path is clear")
    judge(phone, "task", [("light", PHONE), ("dark", PHONE)])
    judge(desk, "run", EVERY_LOOK)
    phone.get_by_text("Something is not as expected").click()
    phone.get_by_label("What is it?").fill("A cart stands near the way.")
    phone.get_by_role("button", name="Note the deviation").click()
    expect(phone.get_by_text("olga noted: A cart stands near the way.")).to_be_visible()
    expect(desk.locator("#run-steps")).to_contain_text("A cart stands near the way.")
    phone.get_by_text("Pass", exact=True).check()
    phone.get_by_role("button", name="Done").click()
    expect(desk.get_by_text("Waits for a signature.", exact=True)).to_be_visible()
    expect(desk.locator("pre")).to_contain_text(f"/robots/{ROBOT} --run {run}")
    judge(desk, "run-signature", [("light", 1440)])
    with signing(world, tmp_path, run):
        for name in ("Drive the distance", "Drive back"):
            expect(phone.get_by_role("heading", name=name)).to_be_visible()
            code = phone.get_by_label("Code at the robot")
            expect(code).to_be_visible()
            judge(phone, f"code-{name[-4:]}", [("dark", PHONE)])
            code.fill(world.code())
            phone.get_by_role("button", name="The way is free").click()
            expect(code).to_have_count(0)
        expect(phone.get_by_role("heading", name="Say what you saw and heard")).to_be_visible()
    expect(desk.locator("[data-bpmn-id=drive].is-done")).to_have_count(1)
    phone.get_by_text("Pass", exact=True).check()
    phone.get_by_text("front left", exact=True).check()
    phone.get_by_role("button", name="Done").click()
    expect(phone.get_by_text("The experiment is over.")).to_be_visible()
    expect(desk.locator("#run-judging")).to_be_visible()
    desk.get_by_label("Enlarge").check()
    with world.fleet() as fleet:  # what happens elsewhere changes nothing of it
        other = fleet.start_run(ROBOT, "make_safe").id
        fleet.abort_run(ROBOT, other)
    expect(phone.get_by_text("The experiment is over.")).to_be_visible()
    expect(desk.get_by_label("Enlarge")).to_be_checked()
    judge(desk, "run-over", EVERY_LOOK)
    desk.get_by_role("link", name="Read and print").click()
    report = desk.locator("body")
    for text in ("Wheel check", "A cart stands near the way.", "noise: front left", "olga"):
        expect(report).to_contain_text(text)
    assert desk.evaluate("() => getComputedStyle(document.querySelector('.verdict')).fontWeight") \
        == "600"  # fmt: skip


def tab_to(page: Page, element: Locator) -> None:
    """Press Tab until an element has the focus, which has to be visible."""
    for _ in range(40):
        page.keyboard.press("Tab")
        if element.evaluate("(one) => one === document.activeElement"):
            outline = "(one) => getComputedStyle(one.closest('.choice') ?? one).outlineStyle"
            own = element.evaluate("(one) => getComputedStyle(one).outlineStyle")
            assert {own, element.evaluate(outline)} != {"none"}, "the focus cannot be seen"
            return
    raise AssertionError(f"Tab does not lead to {element}")


def test_a_step_is_done_with_the_keyboard_alone(page_as: PageAs, world: Commanded) -> None:
    desk = opened(page_as, world, "anna", f"/robots/{ROBOT}/experiments/wheel_check")
    run = started(desk)
    desk.context.close()
    page = opened(page_as, world, "olga", "/tasks")
    tab_to(page, page.get_by_text("Something is not as expected"))
    page.keyboard.press("Enter")
    tab_to(page, page.get_by_label("What is it?"))
    page.keyboard.type("A cart stands near the way.")
    tab_to(page, page.get_by_role("button", name="Note the deviation"))
    page.keyboard.press("Enter")
    expect(page.get_by_text("olga noted: A cart stands near the way.")).to_be_visible()
    page.keyboard.press("Control+Home")
    page.evaluate("document.activeElement.blur()")
    tab_to(page, page.get_by_role("radio", name="Pass"))
    page.keyboard.press("Space")
    tab_to(page, page.get_by_role("button", name="Done"))
    page.keyboard.press("Enter")
    expect(page.get_by_role("heading", name="Drive the distance")).to_be_visible()
    focused = "() => document.activeElement.closest('#task-parts') !== null"
    page.wait_for_function(focused)
    tab_to(page, page.get_by_role("button", name="Abort experiment"))
    page.keyboard.press("Enter")
    with world.fleet() as fleet:
        wait_for(lambda: fleet.run(ROBOT, run).run.state == "aborted", "the end of the run")


def test_steps_and_abort_work_without_scripts(page_as: PageAs, world: Commanded) -> None:
    desk = opened(page_as, world, "anna", f"/robots/{ROBOT}/experiments/wheel_check",
                  java_script_enabled=False)  # fmt: skip
    run = started(desk)
    phone = opened(page_as, world, "olga", "/tasks", PHONE, java_script_enabled=False,
                   expects=["409 POST", "400 POST", "status of 409", "status of 400"])  # fmt: skip
    other = opened(page_as, world, "olga", f"/runs/{run}", java_script_enabled=False,
                   expects=["409 POST", "status of 409"])  # fmt: skip
    phone.get_by_text("Something is not as expected").click()
    phone.get_by_label("What is it?").fill(HOSTILE)
    phone.get_by_text("Fail", exact=True).check()
    phone.get_by_role("button", name="Note the deviation").click()
    expect(phone.get_by_text("The deviation is noted.")).to_be_visible()
    expect(phone.get_by_label("Fail", exact=True)).to_be_checked()
    expect(phone.get_by_text("onerror=alert(1)")).to_be_visible()
    phone.get_by_text("Pass", exact=True).check()
    phone.get_by_role("button", name="Done").click()
    other.get_by_text("Pass", exact=True).check()
    other.get_by_role("button", name="Done").click()
    expect(other.get_by_text("olga has done this step already")).to_be_visible()
    expect(other.get_by_text("no emergency stop")).to_be_visible()
    other.get_by_role("button", name="Abort experiment").click()
    with world.fleet() as fleet:
        wait_for(lambda: fleet.run(ROBOT, run).run.state == "aborted", "the end of the run")
    other.get_by_role("link", name="Look again").click()
    expect(other.locator("#run-head").get_by_text("aborted", exact=True)).to_be_visible()


def test_what_was_typed_stays_while_the_server_restarts(page_as: PageAs, world: Commanded) -> None:
    desk = opened(page_as, world, "anna", f"/robots/{ROBOT}/experiments/wheel_check")
    started(desk)
    desk.context.close()
    phone = opened(page_as, world, "olga", "/tasks", PHONE, expects=RESTART)
    phone.get_by_text("Something is not as expected").click()
    typed = phone.get_by_label("What is it?")
    typed.fill("It hums.")
    world.processes.kill("serve")
    phone.get_by_role("button", name="Note the deviation").click()
    expect(phone.get_by_text("What you have entered is still here")).to_be_visible()
    server = world.processes.again("serve")
    wait_for_listener(world.port, server, world.data.parent / "server.log")
    phone.locator("html[data-feed=live]").wait_for(state="attached")
    expect(typed).to_have_value("It hums.")
    phone.get_by_role("button", name="Note the deviation").click()
    expect(phone.get_by_text("olga noted: It hums.")).to_be_visible()
    expect(typed).to_have_value("")


ANSWERED = """async () => {
  const all = document.querySelector('script[type="module"]').src;
  const { placeParts } = (await import(all)).$need("fragments.js");
  const parts = (opened) => {
    const place = document.createElement("div");
    place.innerHTML = `<section id="step"><form id="form-1"><details id="d"${opened}>
      <textarea name="text"></textarea></details></form></section>`;
    return place;
  };
  const shown = document.body.appendChild(parts(" open"));
  shown.querySelector("textarea").value = "It hums.";
  placeParts(shown, parts(""));  // the feed has brought what was noted; the answer is still to come
  const before = shown.querySelector("textarea").value;
  placeParts(shown, parts(""), "form-1");
  return [before, shown.querySelector("textarea").value, shown.querySelector("details").open];
}"""


def test_what_was_sent_is_cleared_where_the_feed_is_faster_than_the_answer(
    page_as: PageAs, world: Commanded
) -> None:
    phone = opened(page_as, world, "olga", "/tasks", PHONE)
    assert phone.evaluate(ANSWERED) == ["It hums.", "", True]


def test_the_form_names_what_is_wrong(page_as: PageAs, world: Commanded) -> None:
    path = f"/robots/{ROBOT}/experiments/wheel_check?diagnosis=d&test=t"
    page = opened(page_as, world, "anna", path, expects=["400 POST", "status of 400"])
    page.locator("#start form").evaluate("(form) => (form.noValidate = true)")
    page.get_by_label("distance_m").fill("-9")
    page.get_by_label("I have read this.").check()
    page.get_by_role("button", name="Start").click()
    expect(page.get_by_role("alert")).to_contain_text("distance_m")
    expect(page.get_by_label("distance_m")).to_have_value("-9")
    expect(page.locator("input[name=test]")).to_have_value("t")
    page = opened(page_as, world, "olga", f"/robots/{ROBOT}/experiments/wheel_check")
    expect(page.get_by_text("A technician can start this experiment.")).to_be_visible()
    assert page.get_by_role("button", name="Start").count() == 0
