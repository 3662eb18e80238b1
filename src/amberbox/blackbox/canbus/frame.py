"""CAN frames as they are recorded: the bytes of Linux's ``struct canfd_frame``, and their time.

A frame without a definition is recorded as a whole: identifier and flags (4 bytes, little-endian),
length, flags of CAN FD, two reserved bytes, data. Error frames have the same form; their bits are
those of Linux's ``can/error.h``.
"""

from __future__ import annotations

from collections.abc import Mapping
from struct import Struct
from typing import Protocol

from amberbox.blackbox.columns.frame_layout import MESSAGE_ENCODING, FrameField, FrameLayout
from amberbox.core.types import Topic

EXTENDED, REMOTE, ERROR = 1 << 31, 1 << 30, 1 << 29
ID_MASK = (1 << 29) - 1
BIT_RATE_SWITCH, ERROR_STATE, FD = 1, 2, 4
_HEAD = Struct("<IBB2x")
_DATA_BIT = 8 * _HEAD.size

BUS_OFF, RESTARTED, CONTROLLER = 1 << 6, 1 << 8, 1 << 2
RECEIVE_OVERFLOW = 1
"""Bit of the first state byte of an error frame: the controller had no room for a frame."""


class CanFrame(Protocol):
    """A frame; ``can.Message`` of python-can is one."""

    timestamp: float
    arbitration_id: int
    is_extended_id: bool
    is_remote_frame: bool
    is_error_frame: bool
    is_fd: bool
    bitrate_switch: bool
    error_state_indicator: bool
    dlc: int

    @property
    def data(self) -> bytes | bytearray:
        """Return the data, none for a remote frame."""


def pack_frame(frame: CanFrame) -> bytes:
    """Return a frame as it is recorded."""
    number = frame.arbitration_id & ID_MASK
    number |= EXTENDED * frame.is_extended_id | REMOTE * frame.is_remote_frame
    number |= ERROR * frame.is_error_frame
    flags = FD * frame.is_fd | BIT_RATE_SWITCH * frame.bitrate_switch
    flags |= ERROR_STATE * frame.error_state_indicator
    length = frame.dlc if frame.is_remote_frame else len(frame.data)
    return _HEAD.pack(number, length, flags) + bytes(frame.data)


FRAMES = Topic(
    "frames",
    MESSAGE_ENCODING,
    FrameLayout(
        (
            FrameField("id", 0, 29),
            FrameField("extended", 31, 1, "bool"),
            FrameField("remote", 30, 1, "bool"),
            FrameField("length", 32, 8),
            FrameField("fd", 42, 1, "bool"),
            FrameField("bit_rate_switch", 40, 1, "bool"),
            FrameField("error_state", 41, 1, "bool"),
            FrameField("data", _DATA_BIT, 0, "bytes"),
        )
    ).to_schema("can/Frame"),
)

_CLASSES = (
    *("tx_timeout", "lost_arbitration", "controller", "protocol", "transceiver"),
    *("no_acknowledgement", "bus_off", "bus_error", "restarted"),
)
_STATES: Mapping[str, int] = {
    "lost_arbitration_bit": 0, "controller_state": 1, "protocol_type": 2, "protocol_location": 3,
    "transceiver_state": 4, "tx_errors": 6, "rx_errors": 7,
}  # fmt: skip

ERRORS = Topic(
    "errors",
    MESSAGE_ENCODING,
    FrameLayout(
        (
            *(FrameField(name, bit, 1, "bool") for bit, name in enumerate(_CLASSES)),
            *(FrameField(name, _DATA_BIT + 8 * byte, 8) for name, byte in _STATES.items()),
        )
    ).to_schema("can/Error"),
)

_BUS = Struct("<IIII")
_LOADS = Struct("<ff")

BUS = Topic(
    "bus",
    MESSAGE_ENCODING,
    FrameLayout(
        (
            *(
                FrameField(name, 32 * place, 32)
                for place, name in enumerate(("frames", "errors", "malformed", "lost"))
            ),
            FrameField("load", 128, 32, "float", unit="%"),
            FrameField("load_most", 160, 32, "float", unit="%"),
        )
    ).to_schema("can/Bus"),
)


def pack_bus(
    frames: int, errors: int, malformed: int, lost: int, loads: tuple[float, float] | None
) -> bytes:
    """Return one row of the topic ``bus``: counts, and the least and most load in percent."""
    return _BUS.pack(frames, errors, malformed, lost) + (_LOADS.pack(*loads) if loads else b"")


_FD_LONG = 16  # bytes of CAN FD data from which the checksum has 21 bits instead of 17


def wire_time_s(frame: CanFrame, bitrate: int, data_bitrate: int) -> tuple[float, float]:
    """Return how long a frame occupies the bus at the least and at the most, seconds.

    From ISO 11898-1, with three bits of space after the frame. Stuff bits depend on the data: there
    are none at the least, and one in four bits at the most.
    """
    extended, length = frame.is_extended_id, len(frame.data)
    if not frame.is_fd:
        bits, stuffed = (67 if extended else 47) + 8 * length, (54 if extended else 34) + 8 * length
        return bits / bitrate, (bits + (stuffed - 1) // 4) / bitrate
    head, tail, control = (36 if extended else 17), 13, 5
    checksum = 21 if length > _FD_LONG else 17
    body = control + 8 * length + 4 + checksum + (checksum + 4) // 4 + 1
    fast = data_bitrate if frame.bitrate_switch and data_bitrate else bitrate
    least = (head + tail) / bitrate + body / fast
    return least, least + (head - 1) // 4 / bitrate + (control + 8 * length) // 4 / fast
