"""A technician's day: faults come one after the other, on a phone, while both cores are loaded.

A simulated robot is recorded and watched by ``amberbox run`` and linked to a server. After each
fault the pages have to name what is active first, to begin with a safe step where something is
dangerous, to agree with each other and with the API, and to blame nothing that is not disturbed.

``DAY_FAULTS=8`` plays the whole day, as ``make soak`` does; the suite plays the first three.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from fastapi import FastAPI

from amberbox.demo.fleet import SimulatedRobot, robot_paths, write_folder
from amberbox.link.join_line import join_line, read_join_line
from amberbox.server.http.auth import COOKIE
from amberbox.sim.faults import catalogue
from amberbox.testing import clock
from amberbox.testing.clock import wait_until
from tests.browser.conftest import PageAs
from tests.browser.page_checks import no_sideways_scroll
from tests.browser.site import Site
from tests.server.house import House
from tests.support.processes import free_port

if TYPE_CHECKING:
    from playwright.sync_api import Page

ROBOT = "ropod_001"
PHONE = 390
FEW = 3
PATIENCE_S = 5 * clock.PATIENCE_S
"""A box with its watcher and a server start and evaluate while other tests run beside them."""
_BURN = "while True: pass"


@dataclass(frozen=True, slots=True)
class Fault:
    """A fault of the simulator; ``safe`` is the text of the first step while it is active.

    ``shows`` are components that may be named besides its own and its dependents.
    """

    name: str
    magnitude: str = ""
    repaired: bool = True
    safe: str = ""
    shows: Sequence[str] = ()


DAY = (
    Fault("imu_stuck"),
    Fault("localisation_shift", repaired=False),
    Fault("battery_overheats", "1.0", repaired=False, safe="switch (it )?off"),
    Fault("wheel_front_left_bus_disconnected", shows=["wheel_front_left"]),
    Fault("bumper_switch_closed"),
    Fault("laser_rear_motor_slow", repaired=False),
    Fault("wifi_weak"),
    Fault("wheel_rear_right_power_stage_trips"),
)
"""Of mixed severity; none sets a clock."""

SEEN = """() => {
  const all = (selector) => [...document.querySelectorAll(selector)];
  const plain = (one) => one.textContent.trim().replace(/\\s+/g, " ");
  const levels = (one) => [one.dataset.component, one.dataset.level];
  const timing = (one) => plain(one).includes("fine again") ? "over" : "active";
  const head = document.querySelector("#robot-state");
  const count = document.querySelector("[data-alarm-count]");
  return {
    head: head ? JSON.parse(head.dataset.shown) : null,
    count: count ? Number(count.dataset.alarmCount) : 0,
    tree: Object.fromEntries(all("#tree .branch").map(levels)),
    nothing: all("#dx-card .dx-nothing").length > 0,
    causes: all("#dx-card .dx-cause").map(plain),
    reasons: all("#dx-card .dx-why > li").map(timing),
    step: all("#dx-card .dx-step").map(plain)[0] ?? "",
  };
}"""
"""The contents of a page: the only part of this test that depends on its markup."""


@dataclass(frozen=True, slots=True)
class Said:
    """The API's answers about the robot at one moment."""

    card: Mapping[str, Any]
    levels: Mapping[str, str]
    alarms: Sequence[Mapping[str, Any]]

    @property
    def active(self) -> Sequence[Mapping[str, Any]]:
        """Return the alarms that last."""
        return [alarm for alarm in self.alarms if alarm["active"]]


def said(site: Site) -> Said:
    """Ask the API for the robot's card, its components and its alarms."""
    status = site.ask(f"/robots/{ROBOT}/status")
    levels = {
        one["component"]: one["condition"]["level"]
        for one in status["components"] if one["condition"]
    }  # fmt: skip
    alarms = site.ask(f"/alarms?robot={ROBOT}&state=open")
    return Said(site.ask(f"/robots/{ROBOT}"), levels, alarms)


@contextmanager
def served(folder: Path) -> Iterator[tuple[Site, SimulatedRobot]]:
    """Start a server, and the box of a simulated robot that is joined to it; end both."""
    (folder / "server").mkdir(parents=True)
    home = House(folder / "server", FastAPI(), time.time_ns())
    site = Site(folder, free_port(), time.time_ns(), home.keys)
    home.close()
    robot = None
    try:
        site.launch()
        place = robot_paths(ROBOT, folder / "robots")
        write_folder(place, read_join_line(str(join_line(site.url, ROBOT, site.keys[ROBOT]))))
        robot = SimulatedRobot(place)
        wait_until(site.answers, "the server answers")
        yield site, robot
    finally:
        if robot is not None:
            robot.stop()
            robot.wait()
        site.close()


@contextmanager
def loaded() -> Iterator[None]:
    """Keep all cores busy."""
    burners = [subprocess.Popen([sys.executable, "-c", _BURN]) for _ in range(os.cpu_count() or 2)]
    try:
        yield
    finally:
        for burner in burners:
            burner.kill()
            burner.wait()


def blamable(site: Site, faults: Sequence[Fault]) -> set[str]:
    """Return the components that faults disturb, and all that need one of them."""
    of = catalogue()
    found = {of[fault.name].component for fault in faults}
    found |= {name for fault in faults for name in (*of[fault.name].affects, *fault.shows)}
    found.add("log")  # it tells of each task that is given up, whatever the reason
    needs = {
        one["component"]: {need["component"] for need in one["needs"]} | {one["part_of"]}
        for one in site.ask(f"/robots/{ROBOT}/status")["components"]
    }
    while more := {name for name, of_it in needs.items() if of_it & found} - found:
        found |= more
    return found


def contradictions(pages: Sequence[Page], site: Site) -> list[str]:
    """Return the contradictions between the pages and the API; read twice, as time passes."""
    before = said(site)
    seen = [page.evaluate(SEEN) for page in pages]
    after = said(site)
    if (before.levels, before.alarms, before.card["level"]) != (
        after.levels, after.alarms, after.card["level"],
    ):  # fmt: skip
        return ["the API says something else by now"]
    found = [line for shown in seen for line in _disagreements(shown, after)]
    for alarm in after.active:
        if alarm["level"] in ("warn", "error") and after.card["level"] == "ok":
            found.append(f"an alarm of {alarm['origin']} lasts, and the robot is ok")
    return found


def _disagreements(shown: Mapping[str, Any], api: Said) -> Iterator[str]:
    if shown["head"]["level"] != api.card["level"]:
        yield f"the head says {shown['head']['level']}, the API {api.card['level']}"
    if shown["count"] != api.card["alarms"]:
        yield f"{shown['count']} alarms beside the menu, {api.card['alarms']} in the API"
    for component, level in shown["tree"].items():
        if level != api.levels.get(component, "unknown"):
            yield f"the tree says {component} is {level}, the API {api.levels.get(component)}"
    if shown["nothing"] and (api.active or api.card["level"] == "error"):
        yield "nothing is known to be wrong, though something is"
    order = shown["reasons"]
    if "active" in order and order != sorted(order):  # "active" is before "over"
        yield f"what is over stands before what is active: {order}"


class Day:
    """The robot page and the page of its diagnosis, and the faults injected so far."""

    def __init__(self, site: Site, robot: SimulatedRobot, pages: Sequence[Page]) -> None:
        self.site, self.robot, self.pages = site, robot, pages
        self.broken: list[Fault] = []
        self.ever: list[Fault] = []
        self.before = {alarm["id"] for alarm in said(site).alarms}

    def break_(self, fault: Fault) -> None:
        """Let a fault begin, and see that the pages show it."""
        self.broken.append(fault)
        self.ever.append(fault)
        self.robot.order(f"fault {fault.name} {fault.magnitude}".strip())
        concerned = blamable(self.site, [fault])
        known = {alarm["id"]: alarm["count"] for alarm in said(self.site).alarms}
        self.wait(lambda: self._shows(concerned, known), f"{fault.name} is shown")
        if fault.safe:
            self.wait(lambda: self._first_step(fault.safe), f"{fault.name}: {fault.safe} is first")
        self.look()

    def repair(self, fault: Fault) -> None:
        """Repair a fault, and check the pages."""
        self.robot.order(f"heal {fault.name}")
        self.broken.remove(fault)
        self.look()

    def look(self) -> None:
        """Check that pages agree, that nothing healthy is named, and that safe steps come first."""
        self.wait(lambda: not contradictions(self.pages, self.site), "all agree")
        allowed = blamable(self.site, self.ever)
        new = [alarm for alarm in said(self.site).alarms if alarm["id"] not in self.before]
        blamed = {alarm["origin"] for alarm in new}
        assert blamed <= allowed, f"nothing disturbs {blamed - allowed}"
        for fault in self.broken:
            if fault.safe:
                assert self._first_step(fault.safe), self.pages[-1].evaluate(SEEN)["step"]
        for page in self.pages:
            no_sideways_scroll(page)

    def wait(self, condition: Callable[[], object], what: str) -> None:
        """Wait for an event; Playwright works meanwhile. Raises with what disagrees."""

        end_s = time.monotonic() + PATIENCE_S
        while not condition():
            if time.monotonic() > end_s:
                shown = json.dumps([page.evaluate(SEEN) for page in self.pages])[:4000]
                wrong = contradictions(self.pages, self.site)
                raise AssertionError(f"{what}; {wrong}; {said(self.site).active}; {shown}")
            self.pages[0].wait_for_timeout(100)

    def _shows(self, concerned: set[str], known: Mapping[int, int]) -> bool:
        """Return whether there is a new alarm about it, and the robot's page shows it."""
        new = [
            alarm for alarm in said(self.site).active
            if alarm["origin"] in concerned and alarm["count"] > known.get(alarm["id"], 0)
        ]  # fmt: skip
        levels = self.pages[0].evaluate(SEEN)["tree"]
        on_page = any(levels.get(name, "ok") not in ("ok", "unknown") for name in concerned)
        return bool(new) and on_page

    def _first_step(self, safe: str) -> bool:
        return bool(re.search(safe, self.pages[-1].evaluate(SEEN)["step"], re.IGNORECASE))


def is_well(site: Site) -> bool:
    """Return whether all components of the robot have been evaluated, and are ok."""
    found = said(site)
    return found.card["level"] == "ok" and len(found.levels) > 15 and not found.active


@pytest.mark.soak  # it keeps all cores busy
@pytest.mark.timeout(1800)
def test_a_technicians_day(tmp_path: Path, page_as: PageAs) -> None:
    faults = DAY[: int(os.environ.get("DAY_FAULTS", FEW))]
    with served(tmp_path) as (site, robot):
        end_s = time.monotonic() + PATIENCE_S
        while not is_well(site):
            assert time.monotonic() < end_s, said(site)
            time.sleep(0.5)
        pages = [_opened(page_as, site, path) for path in ("", "/diagnosis")]
        try:
            day = Day(site, robot, pages)
            with loaded():
                for fault in faults:
                    day.break_(fault)
                    if fault.repaired:
                        day.repair(fault)
        finally:  # before the server ends: pages would miss it
            for page in pages:
                page.context.close()


def _opened(page_as: PageAs, site: Site, path: str) -> Page:
    """Open a page of the robot on a phone, signed in at this server."""
    page = page_as("", PHONE, at=site.url)
    page.context.add_cookies(
        [{"name": COOKIE, "value": site.session("technician"), "url": site.url}]
    )
    page.goto(f"{site.url}/robots/{ROBOT}{path}")
    page.locator("html[data-feed=live]").wait_for(state="attached")
    return page
