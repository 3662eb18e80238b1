"""Recordings made by others: ROS 1 bags, ROS 2 bags, MCAP."""

from amberbox.blackbox.formats.open import open_recording
from amberbox.blackbox.formats.recording import (
    Damage,
    Part,
    RecordedMessage,
    Recording,
    Report,
    TopicTable,
)

__all__ = [
    "Damage",
    "Part",
    "RecordedMessage",
    "Recording",
    "Report",
    "TopicTable",
    "open_recording",
]
