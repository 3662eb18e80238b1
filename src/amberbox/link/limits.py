"""Limits that both ends of the link keep to."""

from __future__ import annotations

from amberbox.blackbox.journal import reserved

PROTOCOL = 1
PATH = "/link/v1"

FRAME_BYTES = 1 << 20
"""Most that a frame may have; a larger one is refused unread."""
ROW_BYTES = 900_000
"""Rows above this are not sent: they come with their journal."""
ROWS_BYTES = 256 << 10
"""A frame of rows is closed at about this size, so that urgent ones do not wait behind it."""
ROWS_COUNT = 2000
WINDOW = 32
"""Frames of rows that may be on their way without an acknowledgement."""
RUNS_STATED = 256
"""Runs of a writer that a robot tells of, the newest ones."""
VARIABLES = 1000
"""Live values in one frame."""
FILES = 2000
"""Journals named in one frame."""
TEXT_BYTES = 4096
"""Most that a reason or a name in a frame may have."""

BEAT_S = 1.0
SILENT_S = 5.0
"""An end that hears nothing for so long takes the link for dead, whatever TCP says."""
BACKOFF_S = (0.5, 30.0)
PIECE_BYTES = 4 << 20
"""Journals are uploaded in pieces of this size."""

WRITERS = ("main", "keep", "watch")
"""Writers whose conclusions go over the link."""
URGENT = frozenset({reserved.ALARM, reserved.DIAGNOSIS, reserved.EVENT, reserved.SYMPTOM,
                    reserved.INCIDENT, reserved.MISSION, reserved.GAP})  # fmt: skip
CHANNELS = URGENT | {reserved.STATUS}
"""Channels whose rows go over the link; of these all but statuses go first."""
