"""What can be asked and done about alarms."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import msgspec

from amberbox.client import alarm_models
from amberbox.client.paging import paged
from amberbox.client.times import Time, said
from amberbox.client.wire import Wire


class AlarmCalls:
    """The alarms of a server.

    Changes take the ``revision`` of the alarm as it was looked at; raise ConflictError when
    somebody changed it since.
    """

    wire: Wire

    def alarms(
        self, robot: str = "", *, state: Sequence[str] = (), group: str = "",
        severity: str = "warning", since: Time = None,
    ) -> list[alarm_models.AlarmLine]:  # fmt: skip
        """Return alarms, newest first; ``severity`` and worse, changed ``since`` then."""
        asked = {"robot": robot, "state": list(state), "group": group, "severity": severity,
                 "since": said(since)}  # fmt: skip
        return [*paged(self.wire, "/alarms", alarm_models.AlarmLine, lambda a: a.id, asked)]

    def alarm(self, alarm: int) -> alarm_models.AlarmPage:
        """Return an alarm with its consequences and its history."""
        found = self.wire.get(f"/alarms/{alarm}").body
        return msgspec.json.decode(found, type=alarm_models.AlarmPage)

    def acknowledge(self, alarm: int, revision: int, note: str = "") -> alarm_models.AlarmPage:
        """Say that one sees to it."""
        return self._do(alarm, "acknowledge", {"revision": revision, "note": note})

    def shelve(self, alarm: int, revision: int, until: Time, reason: str) -> alarm_models.AlarmPage:
        """Put an alarm aside until a time."""
        body = {"revision": revision, "until": said(until), "reason": reason}
        return self._do(alarm, "shelve", body)

    def unshelve(self, alarm: int, revision: int) -> alarm_models.AlarmPage:
        """Take an alarm from the shelf."""
        return self._do(alarm, "unshelve", {"revision": revision})

    def own(self, alarm: int, revision: int, user: str) -> alarm_models.AlarmPage:
        """Make an alarm somebody's business; nobody's with an empty name."""
        return self._do(alarm, "own", {"revision": revision, "user": user})

    def note(self, alarm: int, text: str) -> alarm_models.AlarmPage:
        """Add a note to the history of an alarm."""
        return self._do(alarm, "note", {"text": text})

    def resolve(self, alarm: int, revision: int, reason: str) -> alarm_models.AlarmPage:
        """Close an alarm; it opens again when the robot finds it anew."""
        return self._do(alarm, "resolve", {"revision": revision, "reason": reason})

    def _do(self, alarm: int, action: str, body: Mapping[str, Any]) -> alarm_models.AlarmPage:
        reply = self.wire.send("POST", f"/alarms/{alarm}/{action}", body)
        return msgspec.json.decode(reply.body, type=alarm_models.AlarmPage)
