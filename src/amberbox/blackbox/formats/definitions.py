"""Message definitions for ROS 2 bags that carry none: taken from the ROS distributions' own."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

from amberbox.blackbox.formats.compression import unpack_message
from amberbox.blackbox.formats.recording import Report
from amberbox.core.types import Schema

DISTRIBUTIONS = (
    "lyrical", "kilted", "jazzy", "iron", "humble", "galactic", "foxy", "eloquent", "dashing",
)  # fmt: skip
"""ROS 2 distributions whose definitions are known, newest first."""

Sample = Callable[[], "bytes | None"]
"""Gives one message of the topic, to try a definition on."""


class Definitions:
    """Completes the schemas of one recording and says in its report where they come from."""

    def __init__(self, report: Report, distribution: str = "") -> None:
        self.report = report
        self.distribution = distribution

    def schema(self, type_name: str, sample: Sample) -> Schema:
        """Return the definition of a type; one with empty text if nobody knows it.

        The distribution that the recording names comes first. Without one it is the newest whose
        definition reads a message of the topic to its last byte.
        """
        candidates = [d for d in self._order() if _knows(d, type_name)]
        if not candidates:
            self.report.add_note(
                f"{type_name}: no definition in the recording and none known; bytes are kept"
            )
            return Schema(type_name, "", b"")
        fitting = self._fitting(candidates, type_name, sample())
        self.report.add_note(f"definitions not in the recording are those of ROS 2 {fitting}")
        return Schema(type_name, "ros2msg", _definition(fitting, type_name))

    def _order(self) -> list[str]:
        return sorted(DISTRIBUTIONS, key=lambda d: d != self.distribution)

    def _fitting(self, candidates: list[str], type_name: str, data: bytes | None) -> str:
        if data is None or candidates[0] == self.distribution:
            return candidates[0]
        plain = unpack_message(data) or data
        fitting = [d for d in candidates if _reads(d, type_name, plain)]
        if not fitting:
            self.report.add_note(f"{type_name}: its messages fit no known definition")
        return (fitting or candidates)[0]


@cache  # a typestore takes 0.1 s to build and never changes
def _typestore(distribution: str) -> Any:
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores(f"ros2_{distribution}"))


def _knows(distribution: str, type_name: str) -> bool:
    return type_name in _typestore(distribution).fielddefs


def _definition(distribution: str, type_name: str) -> bytes:
    text, _ = _typestore(distribution).generate_msgdef(type_name, ros_version=2)
    return str(text).encode()


def _reads(distribution: str, type_name: str, data: bytes) -> bool:
    try:
        _typestore(distribution).deserialize_cdr(data, type_name)
    except Exception:  # rosbags raises whatever its generated code meets in bytes that do not fit
        return False
    return True
