"""The box's own power: kernel power supplies, NUT, the lines and files of a UPS HAT."""

from __future__ import annotations

import dataclasses
import threading
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from amberbox.blackbox.sources.power.judge import Limits
from amberbox.blackbox.sources.power.supply import Supply
from amberbox.blackbox.sources.power.watch import TOPIC, Watch
from amberbox.core.options import option
from amberbox.core.source import Sink, TopicOptions

SAMPLE = """\
- power:
    supplies:
      - {kind: sysfs}
      - {kind: nut, low_percent: 30}
      - {kind: gpio, path: /sys/class/gpio/gpio6/value, means: battery}
    for_s: 1
    low_after_s: 10 min
"""
PASSIVE = "only reads files, and variables of upsd without logging in; it switches nothing"


@dataclass(frozen=True)
class Config:
    """The ``power`` block."""

    supplies: Sequence[Supply] = option((Supply(),), "where to read; the worst of them counts")
    poll_s: float = option(0.5, "how often the supplies are read", unit="s")
    record_s: float = option(1.0, "a message at least this often, and at each change", unit="s")
    for_s: float = option(1.0, "a change counts when it has lasted this long", unit="s")
    low_after_s: float | None = option(
        None, "on battery for this long counts as low; never when absent", unit="s"
    )

    def check(self) -> Iterator[tuple[str, str]]:
        """Say which values cannot work; reads nothing."""
        if not 0.05 <= self.poll_s <= 60:
            yield "poll_s", "must be between 0.05 and 60 seconds"
        if not 0 <= self.for_s < float("inf"):
            yield "for_s", "must be 0 or more"
        if not 0 < self.record_s <= 3600:
            yield "record_s", "must be above 0, and an hour at most"
        if self.low_after_s is not None and self.low_after_s <= 0:
            yield "low_after_s", "must be above 0"
        if not self.supplies:
            yield "supplies", "names none; leave it out to use what the kernel knows"
        for name, count in Counter(supply.title for supply in self.supplies).items():
            if count > 1:
                yield "supplies", f"{count} are called '{name}'; give each a 'name:' of its own"

    def in_folder(self, folder: Path) -> Config:
        """Return the same with paths seen from the robot folder."""
        supplies = tuple(supply.in_folder(folder) for supply in self.supplies)
        return dataclasses.replace(self, supplies=supplies)


class Source:
    """Polls the supplies of the box; says at once when it runs on its own battery."""

    lossless = False

    def __init__(self, config: Config, name: str) -> None:
        self.config = config
        self.name = name

    def topics(self) -> Sequence[TopicOptions]:
        """Return the one topic that is always there: all supplies together."""
        return [TopicOptions(name=TOPIC)]

    def run(self, sink: Sink, stop: threading.Event) -> None:
        """Read until ``stop``; supplies may be missing at first, and go and come back."""
        config = self.config
        limits = Limits(config.for_s, config.low_after_s)
        watch = Watch(config.supplies, limits, config.record_s, sink)
        try:
            while not stop.is_set():
                watch.poll(time.monotonic())
                stop.wait(config.poll_s)
        finally:
            watch.close()
