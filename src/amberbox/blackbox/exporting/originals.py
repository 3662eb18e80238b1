"""The original messages of a view, with what latched topics had said before it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from amberbox.blackbox.exporting.job import Job
from amberbox.blackbox.exporting.messages import (
    Messages,
    MessageStream,
    latched_before,
    without_originals,
)
from amberbox.blackbox.exporting.view import Window, chosen_items, ordered_windows
from amberbox.blackbox.follow.batching import Stream
from amberbox.core.errors import AmberboxError


@dataclass(frozen=True)
class Originals:
    """The streams that there are, and their messages in order of receipt."""

    streams: list[Stream]
    blocks: Iterator[Messages]


def read_originals(job: Job) -> Originals:
    """Choose the messages of a view and read them; what there is no original of is reported.

    Each window begins with a copy of what each latched topic had said last, so that a player
    shows it. Raises AmberboxError when there is not one message.
    """
    ask = job.looking.ask
    items = ask(lambda catalogue: chosen_items(catalogue, job.view))
    chosen = MessageStream(items, job.view.with_box)
    windows = ordered_windows(job.view.windows)
    for window in windows:
        for text in without_originals(job.looking.catalogue, chosen, window):
            job.report.miss(text)
    streams = ask(chosen.streams)
    if not streams:
        raise AmberboxError(
            "there are no original messages of these items",
            job.report.missing[0] if job.report.missing else "'amberbox items' lists what there is",
        )
    return Originals(streams, _blocks(job, chosen, windows))


def _blocks(job: Job, chosen: MessageStream, windows: list[Window]) -> Iterator[Messages]:
    for number, window in enumerate(windows):
        if window[0] is not None:
            yield from _latched(job, chosen, window[0])
        for messages, done in chosen.read(job.looking, window):
            _count(job, messages)
            yield messages
            job.progress((number + done) / len(windows))
    job.progress(1.0)


def _latched(job: Job, chosen: MessageStream, from_ns: int) -> Iterator[Messages]:
    found = job.looking.ask(lambda catalogue: latched_before(catalogue, chosen, from_ns))
    if found:
        for stream, _, _ in found:
            job.report.note(f"{stream.item} is latched: its last message stands at the start again")
        yield latched_messages(found, from_ns)


def latched_messages(found: list[tuple[Stream, int, bytes]], at_ns: int) -> Messages:
    """Lay out what latched topics had said as messages received at one moment."""
    count = len(found)
    times = np.full(count, at_ns)
    return Messages(
        [stream for stream, _, _ in found],
        np.arange(count),
        times,
        np.array([publish_ns for _, publish_ns, _ in found]),
        np.zeros(count, np.int64),
        np.zeros(count, np.int64),
        [message for _, _, message in found],
    )


def _count(job: Job, messages: Messages) -> None:
    places, counts = np.unique(messages.stream, return_counts=True)
    for place, count in zip(places.tolist(), counts.tolist(), strict=True):
        job.report.add(messages.streams[place].item, count)
