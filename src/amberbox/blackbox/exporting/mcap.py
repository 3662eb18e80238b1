"""MCAP files with the messages as they came, for every tool that reads MCAP."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from amberbox.blackbox.exporting.job import Job, new_file, size_of
from amberbox.blackbox.exporting.mcapfile import McapFile
from amberbox.blackbox.exporting.messages import Messages
from amberbox.blackbox.exporting.originals import read_originals
from amberbox.blackbox.exporting.viewerschema import viewer_schema
from amberbox.blackbox.follow.batching import Stream
from amberbox.blackbox.journal.frame import Rows

_QOS = (
    "- history: 1\n  depth: 1\n  reliability: 1\n  durability: 1\n"
    "  deadline:\n    sec: 9223372036\n    nsec: 854775807\n"
    "  lifespan:\n    sec: 9223372036\n    nsec: 854775807\n"
    "  liveliness: 1\n  liveliness_lease_duration:\n    sec: 9223372036\n    nsec: 854775807\n"
    "  avoid_ros_namespace_conventions: false"
)
"""Transient local, as rosbag2 writes it for a latched topic."""


def write_mcap(job: Job) -> None:
    """Write one MCAP file, messages of all items in order of receipt."""
    originals = read_originals(job)
    with new_file(job.path) as part, part.open("wb") as file:
        output = McapFile(file, profile({s.topic.message_encoding for s in originals.streams}))
        channels: dict[Stream, int] = {}
        for messages in originals.blocks:
            _write(output, channels, messages)
        output.close()
    job.report.bytes = size_of(job.path)
    if {"json", "msgpack"} & {s.topic.message_encoding for s in channels} and _cdr(channels):
        job.report.note("rosbags reads files of ROS 2 items only: choose these with --item")


def profile(encodings: set[str]) -> str:
    """Name the MCAP profile of a set of message encodings."""
    ros = encodings & {"ros1", "cdr"}
    return {"ros1": "ros1", "cdr": "ros2"}[ros.pop()] if len(ros) == 1 else ""


def _cdr(streams: Iterable[Stream]) -> bool:
    return any(stream.topic.message_encoding == "cdr" for stream in streams)


def _write(output: McapFile, channels: dict[Stream, int], messages: Messages) -> None:
    for place in np.unique(messages.stream).tolist():
        stream = messages.streams[place]
        if stream not in channels:
            topic = replace(stream.topic, schema=viewer_schema(stream.topic.schema))
            channels[stream] = output.channel(topic, channel_metadata(stream))
    numbers = np.array([channels.get(stream, 0) for stream in messages.streams], np.uint16)
    output.write(
        Rows(
            numbers[messages.stream],
            messages.seq,
            messages.received_ns,
            messages.publish_ns,
            messages.data,
        )
    )


def channel_metadata(stream: Stream) -> dict[str, str]:
    """Say what a channel is: for us, and whether it is latched in the words of ROS."""
    marks = {"item": stream.item, "source": stream.source}
    if stream.stamp is not None:
        marks["stamp"] = stream.stamp
    if stream.topic.latched:
        marks["latched"] = "1"
        if stream.topic.message_encoding == "ros1":
            marks["latching"] = "1"
        elif stream.topic.message_encoding == "cdr":
            marks["offered_qos_profiles"] = _QOS
    return marks
