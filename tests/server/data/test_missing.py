"""What kind of a gap a reason names: pages draw by it, and records of all years must fit."""

from __future__ import annotations

import pytest

from amberbox.core.api import GapKind
from amberbox.server.archive.gaps import OLD, TO_COME, WAITING
from amberbox.server.data.recordings import kind_of


@pytest.mark.parametrize(
    ("reason", "kind"),
    [
        (TO_COME, "to_come"),
        (WAITING, "waiting"),
        (OLD, "deleted"),
        (f"{OLD}, the journal is kept", "deleted"),
        ("deleted on the robot before it was copied: lost patience", "deleted"),
        ("filtered: unchanged", "filtered"),
        ("lost at a power cut", "lost"),
        ("delivered, then lost in a power cut", "lost"),
        ("dropped: the disk is too slow", "lost"),
        ("damaged: main-000001.mcap", "lost"),
        ("undecodable: the message ends early", "lost"),
        ("refused: journal/1-1-1.mcap: its signature is not right", "refused"),
        ("the publisher refused the connection", "lost"),
        ("no columns, only in main-000001.mcap: unknown type", "lost"),
        ("the box was not recording", "uncovered"),
        ("publisher not connected yet", "uncovered"),
    ],
)
def test_the_kind_of_a_gap(reason: str, kind: GapKind) -> None:
    assert kind_of(reason) == kind
