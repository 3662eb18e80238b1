"""Files that a server has and does not take: entered as the desk enters what does not hold."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from amberbox.server.schema import UPLOAD
from tests.server.archive.recordings import Robot
from tests.server.house import House

WHY = "altered: a block was changed"


@contextmanager
def quarantined(
    home: House, robot: Robot, *journals: str, came_ns: int, **read: object
) -> Iterator[None]:
    """Quarantine journals that arrived invalid; ``read`` is the readable part of them."""
    row = {
        "robot": robot.name, "store_id": robot.store_id, "sha256": "d" * 64,
        "bytes": 99, "state": "quarantined", "reason": WHY, "path": "", "signed": False,
        "writer": "", "run": 0, "number": 0, "first_seq": 0, "end_seq": 0, "start_ns": 0,
        "end_ns": 0, "began_ns": came_ns, "ended_ns": came_ns, **read,
    }  # fmt: skip
    with home.services.database.begin() as connection:
        connection.execute(UPLOAD.insert(), [{**row, "journal": name} for name in journals])
    try:
        yield
    finally:
        with home.services.database.begin() as connection:
            connection.execute(UPLOAD.delete().where(UPLOAD.c.journal.in_(journals)))
