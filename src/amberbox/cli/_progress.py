"""A progress bar on stderr, for verbs that take their time."""

from __future__ import annotations

import sys
from collections.abc import Callable

from amberbox.core.terminal import BACK

_BAR = 30


def progress_bar(*, wanted: bool = True) -> Callable[[float], None]:
    """Return what draws a fraction as a bar, or does nothing where nobody looks at stderr."""
    if not wanted or not sys.stderr.isatty():
        return lambda fraction: None
    shown = -1

    def draw(fraction: float) -> None:
        nonlocal shown
        percent = round(100 * min(max(fraction, 0.0), 1.0))
        if percent == shown:
            return
        shown = percent
        full = round(percent * _BAR / 100)
        end = "\n" if percent == 100 else ""
        print(f"{BACK}[{'#' * full}{'.' * (_BAR - full)}] {percent:3d}%", end=end, file=sys.stderr,
              flush=True)  # fmt: skip

    return draw
