"""Try whether a new technician finds out what is broken: a minute, five clicks, and rightly.

``python -m tools.tour`` runs the demonstration for each of some faults, breaks a robot once all
are well, and goes through the real pages; clicks and seconds are from the server's access log.
``--shots docs/start/tour`` takes the pictures of docs/start/tour.md of the last fault.
"""

from __future__ import annotations

import argparse
import re
import shutil
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urljoin

from amberbox.core.errors import AmberboxError
from amberbox.demo.fleet import OFFERED_FAULTS
from tools.tour.notes import Notes, Trail, trail_of, truth_of
from tools.tour.stage import Demonstration, demonstration
from tools.tour.technician import Colleague, answer_of, find_out, opened, robot_card

if TYPE_CHECKING:
    from playwright.sync_api import Browser, FloatRect, Page


MOST_S, MOST_CLICKS = 60.0, 5
FAULTS = ("localisation_crash", "laser_rear_motor_slow", "wheel_front_left_bus_disconnected")
NUMBER, ROBOT = 2, "ropod_002"
_WHO, _ON_SITE = "technician", "operator"
_PORT = 8643
_ARGUMENTS = ("--no-sandbox", "--disable-dev-shm-usage")


@dataclass(frozen=True, slots=True)
class Trial:
    """One time: what was broken, what was written down, what the log says of the way there."""

    fault: str
    notes: Notes
    trail: Trail

    def wrong(self) -> Iterator[str]:
        """Yield what is not as it has to be."""
        yield from truth_of(self.fault).wrong(self.notes)
        if self.trail.seconds > MOST_S:
            yield f"{self.trail.seconds:.1f} s are more than {MOST_S:.0f} s"
        if self.trail.clicks > MOST_CLICKS:
            yield f"{self.trail.clicks} clicks are more than {MOST_CLICKS}"

    def row(self) -> str:
        """Write a row of the table."""
        causes = "; or: ".join(self.notes.causes)
        cells = (
            f"`{self.fault}`", f"{causes} ({self.notes.sure})", self.notes.why[0], self.notes.use,
            self.notes.next, str(self.trail.clicks), f"{self.trail.seconds:.1f}",
        )  # fmt: skip
        return f"| {' | '.join(cells)} |"


def main(arguments: Sequence[str] | None = None) -> int:
    """Try, and print a table; 1 if something took too long, too much, or was wrong."""
    asked = _parser().parse_args(arguments)
    try:
        trials = _tried(asked.faults, asked.port, asked.shots)
    except AmberboxError as error:
        print(f"error: {error.what}\nhint: {error.hint}", file=sys.stderr)
        return 1
    print("\n| what was broken | cause | why | can it be used? | next step | clicks | seconds |")
    print("|---|---|---|---|---|---|---|")
    print("\n".join(trial.row() for trial in trials))
    wrong = [f"{trial.fault}: {what}" for trial in trials for what in trial.wrong()]
    print("\n".join(wrong), file=sys.stderr)
    return 1 if wrong else 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m tools.tour", description=__doc__)
    parser.add_argument("--faults", nargs="+", choices=tuple(OFFERED_FAULTS), default=FAULTS)
    parser.add_argument("--port", type=int, default=_PORT)
    parser.add_argument("--shots", type=Path, help="folder for pictures of the last fault")
    return parser


def _tried(faults: Sequence[str], port: int, shots: Path | None) -> list[Trial]:
    """Try each fault on robots that were well until then; pictures are of the last one."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        chromium = shutil.which("chromium") or shutil.which("chromium-browser")
        browser = playwright.chromium.launch(executable_path=chromium, args=list(_ARGUMENTS))
        trials = []
        for fault in faults:
            with demonstration(port) as demo:
                Colleague.arrived(demo.links()["admin"]).damage(ROBOT, fault)
                trials.append(_tell(_try(browser, demo, fault)))
                if fault == faults[-1] and shots is not None:
                    take(browser, demo, NUMBER, shots)
        browser.close()
        return trials


def _try(browser: Browser, demo: Demonstration, fault: str) -> Trial:
    """Find out once; the lines of the log from its beginning to its end are its way."""
    link, before = demo.links()[_WHO], len(demo.log())
    with opened(browser, link) as page:
        notes = find_out(page, NUMBER)
    return Trial(fault, notes, trail_of(demo.log()[before:], f"user:{_WHO}"))


def _tell(trial: Trial) -> Trial:
    print(f"{trial.fault}: {' > '.join(trial.trail.pages)}, {trial.trail.seconds:.1f} s\n"
          f"{trial.notes}\n", flush=True)  # fmt: skip
    return trial


_SETTLE_MS = 2500  # wait before a screenshot: plots and values have come by then


def take(browser: Browser, demo: Demonstration, number: int, folder: Path) -> None:
    """Write the pictures to a folder: a robot is broken now."""
    folder.mkdir(parents=True, exist_ok=True)
    with opened(browser, demo.links()[_WHO]) as page:
        _walk(page, number, folder)
    with opened(browser, demo.links()[_WHO], theme="dark") as page:
        _to_answer(page, number)
        _shot(page, folder, "diagnosis-dark")
    with opened(browser, demo.links()[_WHO], width=390, height=844) as page:
        _to_answer(page, number)
        _shot(page, folder, "diagnosis-narrow", height=1100)
    with (
        opened(browser, demo.links()[_WHO]) as desk,
        opened(browser, demo.links()[_ON_SITE], width=390, height=844) as phone,
    ):
        _experiment(desk, phone, folder)


def _walk(page: Page, number: int, folder: Path) -> None:
    """Go from the list to the answer, to the data that it rests on, to robot and alarm."""
    _shot(page, folder, "robots", height=420)
    _to_answer(page, number)
    _shot(page, folder, "diagnosis")
    reason = page.get_by_role("main").get_by_title("The data of that moment").first
    reason.click()
    page.wait_for_url("**/data?*")
    _shot(page, folder, "data")
    page.get_by_role("link", name="Status", exact=True).click()
    page.get_by_role("treegrid").first.wait_for()
    _shot(page, folder, "robot", height=500)
    page.get_by_role("main").get_by_role("link", name=re.compile("open alarm")).first.click()
    page.get_by_role("heading", name="Alarms").wait_for()
    _shot(page, folder, "alarms")


def _experiment(desk: Page, phone: Page, folder: Path) -> None:
    """Start an experiment at a desk: the first step waits for somebody with a phone."""
    desk.goto(urljoin(desk.url, f"/robots/{ROBOT}/experiments"))
    desk.get_by_role("link", name="Wheel check").click()
    desk.get_by_label("I have read this.").check()
    desk.get_by_role("button", name="Start").click()
    desk.wait_for_url("**/runs/r-*")
    phone.goto(urljoin(phone.url, "/tasks"))
    phone.get_by_text("Step 1 of").wait_for()
    _shot(desk, folder, "experiment")
    _shot(phone, folder, "experiment-step")
    desk.get_by_role("button", name="Abort experiment").click()


def _to_answer(page: Page, number: int) -> None:
    robot_card(page, number).get_by_role("link", name="What is broken?").click()
    answer_of(page)


def _shot(page: Page, folder: Path, name: str, height: int = 0) -> None:
    """Take a picture of the upper part of the page."""
    page.wait_for_timeout(_SETTLE_MS)
    size = page.viewport_size
    assert size is not None, "the window has a size"
    clip: FloatRect = {"x": 0, "y": 0, "width": size["width"], "height": height or size["height"]}
    path = folder / f"{name}.png"
    page.screenshot(path=path, clip=clip, full_page=True)
    print(f"{path}: {path.stat().st_size:,} bytes", flush=True)


if __name__ == "__main__":
    sys.exit(main())
