"""What the filters keep of jittering streams, and what they cost per message."""

from __future__ import annotations

import struct
from collections.abc import Iterator

import numpy as np

from amberbox.blackbox.filters.change import ChangeFilter
from amberbox.blackbox.filters.image import ImageFilter
from amberbox.blackbox.filters.rate import TOLERANCE_PERIODS, RateLimit
from amberbox.core.source import ChangeOptions, ImageOptions
from amberbox.core.types import Column, IntArray, ItemSchema, Rows, Schema, Topic
from benchmarks.common import Row, cpu_s

START_NS = 1_700_000_000_000_000_000
MESSAGES = 6_000
SEEDS = 20
LONG = 100_000
COLUMNS = 50
BATCHES = 50


def measure() -> list[Row]:
    """Measure shares of messages kept and CPU time."""
    return [
        *_kept_shares(),
        *_tolerances(),
        *_bad_minutes(),
        _after_a_stall(),
        _cost_of_rate_limit(),
        *_cost_of_change_filter(),
        *_cost_of_images(),
    ]


def timer_paced(rate_hz: float, rng: np.random.Generator, count: int = MESSAGES) -> IntArray:
    """Arrivals around a steady schedule, each up to 30 % of a period early or late."""
    places = np.arange(count) + rng.uniform(-0.3, 0.3, count)
    return START_NS + (places * 1e9 / rate_hz).astype(np.int64)


def drifting(rate_hz: float, rng: np.random.Generator, count: int = MESSAGES) -> IntArray:
    """Arrivals whose intervals vary by up to 30 %: a random walk around the schedule."""
    intervals = (1 + rng.uniform(-0.3, 0.3, count)) * 1e9 / rate_hz
    return START_NS + np.cumsum(intervals).astype(np.int64)


RATES_HZ = (10.0, 10.05)
ARRIVALS = {"each arrival +-30 % of a period": timer_paced, "each interval +-30 %": drifting}


def _kept_shares() -> Iterator[Row]:
    for jitter, arrive in ARRIVALS.items():
        for rate_hz in RATES_HZ:
            streams = [arrive(rate_hz, np.random.default_rng(seed)) for seed in range(SEEDS)]
            name = f"kept of {rate_hz:g} Hz limited to 10 Hz, {jitter}"
            note = f"worst of {SEEDS} streams of {MESSAGES:,} messages; to be >= 99"
            yield Row(name, 100 * min(map(_share, streams)), "%", note=note)


def _tolerances() -> Iterator[Row]:
    """Why ``TOLERANCE_PERIODS`` is what it is: the table of docs/robot/filters.md."""
    for jitter, arrive in ARRIVALS.items():
        for rate_hz in RATES_HZ:
            streams = [arrive(rate_hz, np.random.default_rng(seed), LONG) for seed in range(4)]
            for periods in (1, 3, 5, TOLERANCE_PERIODS):
                share = float(np.mean([_share(stream, periods) for stream in streams]))
                name = f"kept of {rate_hz:g} Hz, {jitter}, {periods} periods early"
                yield Row(name, 100 * share, "%", note=f"mean of 4 streams of {LONG:,} messages")


def _bad_minutes() -> Iterator[Row]:
    streams = [drifting(10.05, np.random.default_rng(seed), 600) for seed in range(1000)]
    for periods in (5, TOLERANCE_PERIODS):
        bad = float(np.mean([_share(stream, periods) < 0.99 for stream in streams]))
        name = f"minutes of drifting 10.05 Hz that keep less than 99 %, {periods} periods early"
        yield Row(name, 100 * bad, "%", note="of 1,000 single minutes")


def _share(received_ns: IntArray, periods: int = TOLERANCE_PERIODS) -> float:
    return float(RateLimit(10, periods).mask(received_ns).mean())


def _after_a_stall() -> Row:
    limit = RateLimit(10)
    limit.mask(START_NS + np.arange(100) * 100_000_000)
    burst_ns = START_NS + 15_000_000_000 + np.arange(50) * 10_000
    kept = int(limit.mask(burst_ns).sum())
    return Row("kept of the 50 messages that arrive at once after 5 s", kept, "messages")


def _cost_of_rate_limit() -> Row:
    received_ns = drifting(20.0, np.random.default_rng(0)).tolist()
    accept = RateLimit(10).accept

    def all_messages() -> None:
        for time_ns in received_ns:
            accept(time_ns)

    return Row("rate limit, CPU per message", cpu_s(all_messages) / MESSAGES * 1e9, "ns")


def _cost_of_change_filter() -> Iterator[Row]:
    columns = tuple(Column(f"c{n}", f"c{n}", "float64") for n in range(COLUMNS))
    schema = ItemSchema("demo/Wide", columns)
    for rows in (10, 100):
        for name, options in (
            ("any difference", ChangeOptions()),
            ("dead bands", ChangeOptions(absolute=0.05)),
        ):
            seconds = _change_s(schema, options, rows)
            what = f"change filter ({name}), CPU per batch of {rows} rows x {COLUMNS} columns"
            yield Row(what, seconds / BATCHES * 1e6, "us")


def _change_s(schema: ItemSchema, options: ChangeOptions, rows: int) -> float:
    rng = np.random.default_rng(1)
    names = [column.name for column in schema.columns]
    batches = [
        Rows(rows, {name: np.cumsum(rng.normal(0, 0.001, rows)) for name in names})
        for _ in range(BATCHES)
    ]
    times_ns = np.arange(rows, dtype=np.int64) * 10_000_000

    def all_batches() -> None:
        change = ChangeFilter(options, schema)
        for number, batch in enumerate(batches):
            change.mask(batch, times_ns + number * rows * 10_000_000)

    return cpu_s(all_batches)


def _cost_of_images() -> Iterator[Row]:
    """CPU time of images of 5 MB: at 10 Hz one core has 100 ms for each."""
    width, height = 1800, 960
    rng = np.random.default_rng(2)
    blocks = rng.integers(0, 256, (height // 8, width // 8, 3), np.uint8)
    pixels = np.kron(blocks, np.ones((8, 8, 1), np.uint8))
    head = struct.pack("<IIII", 0, 1, 2, 0) + struct.pack("<III", height, width, 4) + b"bgr8"
    message = head + struct.pack("<BII", 0, 3 * width, pixels.size) + pixels.tobytes()
    topic = Topic("/camera", "ros1", Schema("sensor_msgs/Image", "ros1msg", b""))
    for scale in (1.0, 0.5, 0.25):
        images = ImageFilter(ImageOptions(scale=scale, quality=70), topic)
        size = len(images.convert(message))

        def ten(images: ImageFilter = images) -> None:
            for _ in range(10):
                images.convert(message)

        what = f"image of {len(message) / 1e6:.1f} MB scaled to {scale:g}, JPEG of quality 70, CPU"
        yield Row(what, cpu_s(ten) / 10 * 1e3, "ms", note=f"{size / 1e3:.0f} kB; to be < 100")
