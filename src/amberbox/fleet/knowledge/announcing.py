"""Tells the rest of the server of each diagnosis that comes from a robot."""

from __future__ import annotations

import msgspec

from amberbox.blackbox.journal import reserved
from amberbox.fleet.bus import Bus, Change


class _Diagnosis(msgspec.Struct):
    """Of a diagnosis what it is known by."""

    id: str


_DECODER = msgspec.json.Decoder(_Diagnosis)


def announce(bus: Bus) -> None:
    """Publish a change for each diagnosis among the rows that robots send."""

    def told(change: Change) -> None:
        names: dict[str, None] = {}
        for row in change.data["rows"]:
            if row.channel == reserved.DIAGNOSIS:
                names.update(_name(row.data))
        for name in names:
            bus.publish(Change("diagnosis", change.robot, {"id": name}))

    bus.on("rows", told)


def _name(data: bytes) -> dict[str, None]:
    try:
        return {_DECODER.decode(data).id: None}
    except msgspec.MsgspecError:
        return {}  # kept as it came, but nothing that could be shown
