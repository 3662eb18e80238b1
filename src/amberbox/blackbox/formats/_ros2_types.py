"""Facts that ROS 2 bags lack: definitions of the ROS distributions, latched topics (QoS)."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any

import yaml

from amberbox.blackbox.formats._recording import RecordingReport, unpack_message
from amberbox.core.types import Schema

# ROS 2 distributions whose definitions are known, newest first
DISTRIBUTIONS = (
    "lyrical", "kilted", "jazzy", "iron", "humble", "galactic", "foxy", "eloquent", "dashing",
)  # fmt: skip

Sample = Callable[[], "bytes | None"]  # returns one message of the topic, to try a definition on


class Ros2Definitions:
    """Completes the schemas of one recording and notes in its report where they come from."""

    def __init__(self, report: RecordingReport, distribution: str = "") -> None:
        self.report = report
        self.distribution = distribution

    def schema(self, type_name: str, sample: Sample) -> Schema:
        """Return the definition of a type; one with empty text if it is unknown.

        The distribution that the recording names comes first. Without one it is the newest whose
        definition reads a message of the topic to its last byte.
        """
        candidates = [d for d in self._order() if type_name in _typestore(d).fielddefs]
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


def _definition(distribution: str, type_name: str) -> bytes:
    text, _ = _typestore(distribution).generate_msgdef(type_name, ros_version=2)
    return str(text).encode()


def _reads(distribution: str, type_name: str, data: bytes) -> bool:
    try:
        _typestore(distribution).deserialize_cdr(data, type_name)
    except Exception:  # rosbags raises whatever its generated code meets in bytes that do not fit
        return False
    return True


_TRANSIENT_LOCAL = (1, "transient_local")  # as a number up to metadata version 8, then as a word


def is_latched(profiles: Any) -> bool:
    """Return whether an offered profile is transient local; ``profiles`` is YAML text or a list."""
    if isinstance(profiles, str):
        profiles = _parse(profiles)
    if not isinstance(profiles, list):
        return False
    return any(isinstance(p, dict) and p.get("durability") in _TRANSIENT_LOCAL for p in profiles)


def _parse(text: str) -> Any:
    try:
        return yaml.safe_load(text)
    except yaml.YAMLError:
        return None
