"""Coordinate frames of a record: the tree with rates and ages, or the transform between two."""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator, Sequence
from typing import Any

from amberbox.blackbox.query.transforms import FrameTree, Transform, read_frames
from amberbox.cli._arguments import accept_relative_times, add_where, opened, time_of
from amberbox.cli._output import print_grid, print_json
from amberbox.core.clock import NS
from amberbox.core.errors import UsageError
from amberbox.core.timestamps import format_time, parse_duration


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    accept_relative_times(parser)
    add_where(parser, "robot folder, store or recording file")
    parser.add_argument(
        "frames", metavar="FRAME", nargs="*",
        help="TARGET SOURCE: the transform of points in SOURCE to TARGET, such as 'map base_link'",
    )  # fmt: skip
    parser.add_argument("--at", metavar="T", help="at this time instead of the newest known one")
    parser.add_argument(
        "--window", metavar="D", default="10m", help="how far back frames are looked for (10m)"
    )
    parser.add_argument("--json", action="store_true", help="a list of frames, or one transform")


def run(args: argparse.Namespace) -> int:
    """Print the tree of frames, or one transform."""
    if len(args.frames) not in (0, 2):
        raise UsageError(
            "name two frames, or none for the tree", "amberbox tf WHERE map base_link --at T"
        )
    window_ns = parse_duration(args.window)
    with opened(args.where) as record:
        at_ns = time_of("--at", args.at, record.time_ns)
        if args.frames:
            target, source = args.frames
            _print_transform(record.transform(target, source, at_ns), as_json=args.json)
            return 0
        end_ns = record.last_ns() if at_ns is None else at_ns
        if end_ns is None:
            print("nothing has been recorded yet")
            return 0
        tree = read_frames(record, end_ns - window_ns, end_ns + 1)
    rows = list(_rows(tree, end_ns))
    if args.json:
        print_json([_json(row) for row in rows])
    elif rows:
        header = ("frame", "rate Hz", "age s", "last stamp (UTC)")
        print_grid(header, [_shown(row) for row in rows])
    else:
        print("no transforms were recorded in this range")
    return 0


Row = tuple[int, str, str, bool, float | None, int | None, float | None]
"""Depth, frame, parent, whether it is static, rate in Hz, last stamp in ns, age in s."""


def _rows(tree: FrameTree, at_ns: int) -> Iterator[Row]:
    """Yield the frames depth first, those without a parent first; frames of a cycle once."""
    parents = {frame: history.parent for frame, history in tree.histories.items()}
    below: dict[str, list[str]] = {}
    for frame, parent in parents.items():
        below.setdefault(parent, []).append(frame)
    frames = tree.frames()
    waiting = [(0, frame) for frame in frames if frame in parents][::-1]
    waiting += [(0, frame) for frame in frames if frame not in parents][::-1]
    seen: set[str] = set()
    while waiting:
        depth, frame = waiting.pop()
        if frame in seen:
            continue
        seen.add(frame)
        waiting += [(depth + 1, child) for child in sorted(below.get(frame, ()), reverse=True)]
        history = tree.histories.get(frame)
        if history is None:
            yield depth, frame, "", False, None, None, None
            continue
        last_ns = int(history.stamps_ns[-1])
        age_s = None if history.static else (at_ns - last_ns) / NS
        yield depth, frame, history.parent, history.static, history.rate_hz, last_ns, age_s


def _shown(row: Row) -> Sequence[Any]:
    depth, frame, parent, static, rate_hz, last_ns, age_s = row
    if not parent:
        return "  " * depth + frame, None, None, None
    rate = "static" if static else rate_hz and round(rate_hz, 2)
    last = None if last_ns is None else format_time(last_ns)
    return "  " * depth + frame, rate, None if age_s is None else round(age_s, 3), last


def _json(row: Row) -> dict[str, Any]:
    depth, frame, parent, static, rate_hz, last_ns, age_s = row
    return {
        "frame": frame,
        "parent": parent or None,
        "depth": depth,
        "static": static,
        "rate_hz": rate_hz,
        "last": None if last_ns is None else format_time(last_ns),
        "age_s": age_s,
    }


def _print_transform(found: Transform, *, as_json: bool) -> None:
    x, y, z, w = found.rotation.tolist()
    angles = (
        math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)),
        math.asin(max(-1.0, min(1.0, 2 * (w * y - z * x)))),
        math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)),
    )
    if as_json:
        print_json(
            {
                "target": found.target,
                "source": found.source,
                "at": format_time(found.at_ns),
                "translation": found.translation.tolist(),
                "rotation": found.rotation.tolist(),
                "roll_pitch_yaw_rad": list(angles),
                "matrix": found.matrix.tolist(),
            }
        )
        return
    print(f"{found.source} in {found.target} at {format_time(found.at_ns)}")
    rows = (
        ("translation x y z", found.translation.tolist(), "m"),
        ("rotation x y z w", found.rotation.tolist(), ""),
        ("roll pitch yaw", [math.degrees(angle) for angle in angles], "deg"),
    )
    for name, values, unit in rows:
        print(f"  {name:<18} {' '.join(f'{value:.6f}' for value in values)} {unit}".rstrip())
