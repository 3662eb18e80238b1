"""The people that the demonstration plays: a technician who signs, and somebody at the robot.

The technician's computer is a thread for each robot. It signs what waits for a signature, as
``amberbox sign --yes-to '*'`` does, with the key beside the robots, and under the lease of the run;
for a command by hand it takes the lease. The person at the robot confirms motions at its socket, as
``amberbox confirm`` does, and sends the robot back to its deliveries after an experiment.
"""

from __future__ import annotations

import logging
import threading
import time
from pathlib import Path

from amberbox.agent.command_socket import (
    OrderOutcome,
    SiteAsks,
    SiteConfirms,
    SiteConnection,
    SiteOrder,
    WaitingMotion,
)
from amberbox.client.commanding import HeldLease, sign_line
from amberbox.client.fleet import Fleet
from amberbox.client.models import CommandLine
from amberbox.client.signing_key import SigningKey
from amberbox.core.errors import AmberboxError, UsageError

_TTL_S = 20
_POLL_S = 0.5
_UNDER_WAY = ("running", "paused", "stopping")
_RESUME = "resume_tasks"
_TRIES = 20
_log = logging.getLogger(__name__)


class PlayedTechnician:
    """Signs the commands for one robot whenever there are some, until this process ends.

    ``store`` is the robot's, whose tasks it resumes after each run.
    """

    def __init__(self, url: str, token: str, robot: str, store: Path, key: SigningKey) -> None:
        self._fleet = Fleet(url, token)
        self._robot, self._store, self._key = robot, store, key
        self._had_run = False
        threading.Thread(target=self._work, name=f"signs for {robot}", daemon=True).start()

    def _work(self) -> None:
        while True:
            try:
                for change in self._fleet.follow([self._robot], ["command", "run"]):
                    self._attend(change.kind)
            except AmberboxError as error:
                _log.error("nobody signs for %s: %s", self._robot, error.what)
            time.sleep(_POLL_S)

    def _attend(self, kind: str) -> None:
        """Sign what waits; once no run is under way any more, have the robot go on."""
        try:
            for line in reversed(self._fleet.commands(self._robot, state=("unsigned",))):
                self._sign(line)
            if kind == "run":
                self._resume_after_run()
        except AmberboxError as error:  # the robot is away, or held by another run: next time
            _log.info("%s: %s", self._robot, error.what)

    def _sign(self, line: CommandLine) -> None:
        """Sign a command; the lease for one by hand is held until it has ended."""
        lease = self._fleet.actions(self._robot).lease
        if lease.holder and lease.run == line.run:
            sign_line(self._fleet, self._robot, line, self._key, lease.number, _TTL_S)
            return
        with HeldLease(self._fleet, self._robot, line.run) as held:
            sign_line(self._fleet, self._robot, line, self._key, held.lease.number, _TTL_S)
            while not self._fleet.command(self._robot, line.id).is_over:
                time.sleep(_POLL_S)

    def _resume_after_run(self) -> None:
        has_run = bool(self._fleet.runs(self._robot, state=_UNDER_WAY, limit=1))
        if self._had_run and not has_run:
            for _ in range(_TRIES):  # its lease may end a moment later than the run
                if resume_tasks(self._store).state == "done":
                    break
                time.sleep(_POLL_S)
        self._had_run = has_run


def resume_tasks(store: Path) -> OrderOutcome:
    """Order a robot at its own socket to go on with its tasks; return what became of it."""
    order = SiteOrder(store, _RESUME, "{}", who="the demonstration")
    try:
        while (outcome := order.wait(_POLL_S)) is None:
            order.renew()
        return outcome
    finally:
        order.close()


def waiting_motion(store: Path) -> WaitingMotion | None:
    """Return the motion that waits at a robot for its confirmation; None if none does.

    Raises AmberboxError where the robot does not run.
    """
    connection = SiteConnection(store)
    try:
        return connection.ask(SiteAsks()).waiting
    finally:
        connection.close()


def confirm_motion(store: Path) -> None:
    """Confirm the motion that waits at a robot; raises UsageError if none does."""
    if waiting_motion(store) is None:
        raise UsageError("no motion waits for its confirmation", "perhaps somebody was faster")
    connection = SiteConnection(store)
    try:
        connection.ask(SiteConfirms(on_site=True))
    finally:
        connection.close()
