"""The story: break a robot, see it found out, acknowledge, answer, repair; and look at the rest."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from amberbox.demo.away import watch_the_absence
from amberbox.demo.browser import Browser
from amberbox.demo.listening import Heard, Listener, is_kind, is_status
from amberbox.demo.robots import IDS
from amberbox.demo.taking import take_home
from amberbox.demo.telling import PATIENCE_S, Telling, check, until
from amberbox.demo.visits import visit_pages

ROBOT = "ropod_001"
FAULT = "wheel_front_left_bus_disconnected"
COMPONENT = "bus"
CAUSE = "wheel_front_left#bus_disconnected"
TEST, ANSWER = "wheel_front_left.plug", "off"
"""What the plug of the wheel unit is found to be: that is the fault."""
_LEAST_WELL = 15
"""So many components are well before anything is broken; the others wait for a first message."""
_SURE = 0.9


def tell(url: str, codes: Mapping[str, str]) -> None:
    """Go through all of it; ``codes`` sign each role in. Raises AmberboxError where it fails."""
    telling = Telling()
    people = {role: sign_in(url, code) for role, code in codes.items()}
    telling.worked(f"{len(people)} people signed in by their links; none works a second time")
    feed = Listener(people["technician"])
    try:
        one = Broken(telling, people["technician"], feed)
        one.go_through()
        watch_the_absence(telling, people["technician"], feed)
        take_home(telling, people["technician"], ROBOT, one.broken_ns)
    finally:
        feed.close()
    visit_pages(telling, people, ROBOT, one.alarm)
    telling.say(f"all {telling.steps} steps worked")


def sign_in(url: str, code: str) -> Browser:
    """Sign somebody in by a link, as its page does; it works once."""
    browser = Browser(url)
    check(browser.sign_in(code).status == 200, "the link signs in")
    check(Browser(url).sign_in(code).status == 400, "a link that was used is refused")
    return browser


@dataclass
class Broken:
    """What happens to one robot, as a technician sees it in the browser."""

    telling: Telling
    browser: Browser
    feed: Listener
    broken_s: float = 0.0
    broken_ns: int = 0
    alarm: int = 0
    diagnosis: str = ""

    def go_through(self) -> None:
        """Go from a robot that is well to one that is well again."""
        for step in (
            self.see_robots, self.damage, self.see_symptom, self.see_alarm, self.see_diagnosis,
            self.acknowledge, self.answer, self.repair,
        ):  # fmt: skip
            step()

    def see_robots(self) -> None:
        """Wait until all are there, and their monitors have seen that they are well."""
        until(self._all_well, lambda: f"all are well; but {'; '.join(self._troubles())}")
        self.telling.worked(f"{', '.join(IDS)} are online and well")

    def damage(self) -> None:
        """Press the button."""
        self.broken_s, self.broken_ns = time.monotonic(), time.time_ns()
        self.browser.send("POST", f"/demo/{ROBOT}/fault", {"fault": FAULT})
        self.telling.worked(f"{ROBOT} is broken: {FAULT}")

    def see_symptom(self) -> None:
        """See the component in error."""
        self._found("symptom", self._wait(is_status(COMPONENT, "error", ROBOT)), COMPONENT)

    def see_alarm(self) -> None:
        """See the alarm, with its reason in words."""
        heard = self._wait(is_kind("alarm", ROBOT))
        self.alarm = int(heard.data["id"])
        alarm = self._alarm()
        check(alarm["active"] and alarm["state"] == "open", "the alarm is open")
        self._found("alarm", heard, f"{alarm['severity']}: {alarm['reason']}")

    def see_diagnosis(self) -> None:
        """See what is to blame, and which test tells more."""
        heard = self._wait(self._blames(lambda revision: CAUSE in _leading(revision)))
        self._found("diagnosis", heard, CAUSE)
        heard = self._wait(self._blames(lambda revision: bool(_test(revision))))
        texts = filter(None, map(_test, self._revisions()))
        self._found("next test", heard, next(texts)["text"])

    def acknowledge(self) -> None:
        """Say that somebody sees to it."""
        said = {"revision": self._alarm()["revision"], "note": "on my way"}
        self.browser.send("POST", f"/alarms/{self.alarm}/acknowledge", said)
        check(self._alarm()["acknowledged"] is not None, "the alarm is acknowledged")
        self.telling.worked(f"alarm {self.alarm} is acknowledged")

    def answer(self) -> None:
        """Say what the test gave; then one cause is left."""
        body = {"test": TEST, "answer": ANSWER}
        path = f"/robots/{ROBOT}/diagnoses/{self.diagnosis}/answers"
        first = self.browser.send("POST", path, body)["hypotheses"][0]
        is_sure = first["faults"] == [CAUSE] and first["probability"] >= _SURE
        check(is_sure, f"with the answer it is {CAUSE}, and nothing else")
        self.telling.worked(f"the plug is off: {CAUSE} ({first['probability']:.0%})")

    def repair(self) -> None:
        """Repair it, and see it well again."""
        since_s = time.monotonic()
        self.browser.send("DELETE", f"/demo/{ROBOT}/fault")
        self._wait(is_status(COMPONENT, "ok", ROBOT), since_s)
        self.telling.worked(f"{ROBOT} is repaired; {COMPONENT} is well again")

    def _wait(self, is_it: Callable[[Heard], bool], since_s: float = 0.0) -> Heard:
        return self.feed.wait(is_it, PATIENCE_S, since_s or self.broken_s)

    def _found(self, what: str, heard: Heard, which: str) -> None:
        self.telling.worked(f"{what} after {heard.at_s - self.broken_s:.1f} s: {which}")

    def _all_well(self) -> bool | None:
        return None if self._troubles() else True

    def _troubles(self) -> list[str]:
        """Say of each robot that is not there, or not well, why."""
        cards = {card["robot"]: card for card in self.browser.get("/robots")}
        return [
            f"{robot}: {cards[robot]['cause']} {cards[robot]['components']}"
            for robot in IDS
            if not _is_well(cards[robot])
        ]

    def _alarm(self) -> Any:
        return self.browser.get(f"/alarms/{self.alarm}")["alarm"]

    def _blames(self, is_it: Callable[[Any], bool]) -> Callable[[Heard], bool]:
        """Make what knows a change by which a diagnosis of the robot is as is wanted."""

        def found(heard: Heard) -> bool:
            if heard.kind != "diagnosis" or heard.robot != ROBOT:
                return False
            self.diagnosis = heard.data[-1]["id"]
            return any(is_it(revision) for revision in self._revisions())

        return found

    def _revisions(self) -> list[Any]:
        detail = self.browser.get(f"/robots/{ROBOT}/diagnoses/{self.diagnosis}")
        revisions: list[Any] = detail["revisions"]
        return revisions


def _is_well(card: Any) -> bool:
    """Tell whether a robot is there, and nothing is in error."""
    levels = card["components"]
    return bool(
        card["online"] and levels.get("ok", 0) >= _LEAST_WELL and not levels.get("error", 0)
    )


def _leading(revision: Any) -> list[str]:
    """Return what may be to blame first of all: one failure mode, or some that look alike."""
    groups = revision["groups"]
    return list(groups[0]["members"]) if groups else []


def _test(revision: Any) -> Any:
    """Return the test of the story, if it is one of those to do next."""
    return next((test for test in revision["next_tests"] if test["id"] == TEST), None)
