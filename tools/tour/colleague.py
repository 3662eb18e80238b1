"""Whoever breaks the robot, without telling the technician what it is."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from amberbox.demo.browser import Browser
from amberbox.demo.telling import check, until

_PATIENCE_S = 240.0
"""All is well, and wrong, within seconds, unless the machine is very busy."""
_LEAST_WELL = 15
"""So many components are well before anything is broken; the others wait for a first message."""


@dataclass(frozen=True, slots=True)
class Colleague:
    """Somebody at another browser."""

    browser: Browser

    @classmethod
    def arrived(cls, link: str) -> Colleague:
        """Let somebody sign in by a link."""
        url, _, code = link.partition("/in#")
        browser = Browser(url)
        check(browser.sign_in(code).status == 200, "the link signs in")
        return cls(browser)

    def damage(self, robot: str, fault: str) -> None:
        """Break a robot that is well; return when there is an alarm: it "misbehaves"."""
        until(lambda: self._is_well(robot) or None, lambda: f"{robot} is well", _PATIENCE_S)
        self.browser.send("POST", f"/demo/{robot}/fault", {"fault": fault})
        until(lambda: self._card(robot)["alarms"] or None, lambda: "there is an alarm", _PATIENCE_S)

    def _is_well(self, robot: str) -> bool:
        card = self._card(robot)
        levels = card["components"]
        return bool(
            card["online"] and levels.get("ok", 0) >= _LEAST_WELL
            and not levels.get("error", 0) and not card["alarms"]
        )  # fmt: skip

    def _card(self, robot: str) -> Any:
        return next(card for card in self.browser.get("/robots") if card["robot"] == robot)
