"""Limits of the link that both ends keep to, its version, and the codes of a 503 answer."""

from __future__ import annotations

import json

from amberbox.blackbox.journal import channels

PROTOCOL = 1
PATH = "/link/v1"

# Largest size of a frame; larger ones are refused unread
FRAME_BYTES = 1 << 20
# Larger rows are not sent; they arrive with their journal
ROW_BYTES = 900_000
# Approximate size of a frame of rows, so that urgent ones do not wait behind it
ROWS_BYTES = 256 << 10
ROWS_COUNT = 2000
# Number of frames of rows that may be unacknowledged
WINDOW = 32
# Number of runs of a writer that a robot states, the newest ones
RUNS_STATED = 256
# Live values in one frame
VARIABLES = 1000
# Journals named in one frame
FILES = 2000
# Longest reason or name in a frame
TEXT_BYTES = 4096

# The capability to carry commands: neither end sends a frame of commands unless both have said it
COMMANDS = "commands1"
# The capability of a server to take rows and journals of LATER_WRITERS
ACT_ROWS = "act1"
# The capability of a server to take journals of the detectors
DETECT_JOURNALS = "detect1"
# The capability of a server to take pictures of experiments in robots' folders
PICTURES = "pictures1"
# What an end may say that it can, and the longest name of a capability or of a frame
CAPABILITIES = 64
CAPABILITY_LENGTH = 64
# Commands of one frame, and their approximate size
COMMANDS_COUNT = 100
COMMANDS_BYTES = 256 << 10
# Largest size of what a robot announces that it can do
ACTIONS_BYTES = 256 << 10
# Answers in one frame
ANSWERS_COUNT = 200
# Revoked keys in one frame
KEYS_COUNT = 1000

BEAT_S = 1.0
# An end that receives nothing for so long takes the link as dead, whatever TCP reports
SILENT_S = 5.0
# Journals are uploaded in pieces of this size
PIECE_BYTES = 4 << 20

# Writers whose conclusions go over the link; servers before ACT_ROWS end it over the later ones
FIRST_WRITERS = ("main", "keep", "watch")
LATER_WRITERS = ("act", "experiment")
WRITERS = FIRST_WRITERS + LATER_WRITERS
URGENT = frozenset({channels.ALARM, channels.DIAGNOSIS, channels.EVENT, channels.SYMPTOM,
                    channels.INCIDENT, channels.MISSION, channels.GAP})  # fmt: skip
# Rows of commands and of experiments: after the urgent ones, before statuses
COMMAND_CHANNELS = frozenset({channels.COMMAND, channels.EXPERIMENT})
# Channels whose rows go over the link
CHANNELS = URGENT | COMMAND_CHANNELS | {channels.STATUS}


# The server has no admin yet; retrying helps only once one exists
NOT_SET_UP = "not_set_up"
# Too busy at the moment: retry
BUSY = "busy"
# The server's database is damaged: a person has to restore it
DAMAGED = "damaged"


def why_unavailable(body: bytes) -> str:
    """Return the reason why a server answered 503, from the body of its answer."""
    try:
        error = json.loads(body)["error"]
        code, what = str(error.get("code", "")), str(error["what"])
    except (ValueError, KeyError, TypeError, AttributeError):  # sent by a proxy, or no body
        return "it is too busy, or not set up yet"
    if code == NOT_SET_UP:
        return (
            "it is not set up yet and waits for its first admin: on the server "
            "'amberbox serve add-user NAME --data DIR', or its page /setup"
        )
    return what[:300]
