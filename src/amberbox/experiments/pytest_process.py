"""The process in which pytest runs the unit tests of a robot, within limits.

``python -P -m amberbox.experiments.pytest_process PARENT [ARGUMENTS]``, in the robot folder, with
the socket of ``unit_test_messages`` and standard output to the process that supervises it. It is
killed when that one dies.
"""

from __future__ import annotations

import os
import resource
import signal
import sys
from pathlib import Path

from amberbox.core.child_process import end_with_parent

MEMORY_BYTES = 1 << 30
FILE_BYTES = 1 << 28
MOST_PROCESSES = 64
_MORE_THREADS = 256  # of the user in all, also those of other programs


def limit(parent: int) -> None:
    """Set the limits of this process and its children; end it if the parent is gone already."""
    end_with_parent(parent, signal.SIGKILL)
    _lower(resource.RLIMIT_DATA, MEMORY_BYTES)
    _lower(resource.RLIMIT_FSIZE, FILE_BYTES)
    _lower(resource.RLIMIT_CORE, 0)
    # what slows down something that multiplies until it is killed; root has no such limit
    _lower(resource.RLIMIT_NPROC, _threads_of_user() + _MORE_THREADS)


def _lower(kind: int, value: int) -> None:
    _, most = resource.getrlimit(kind)
    bound = value if most == resource.RLIM_INFINITY else min(value, most)
    resource.setrlimit(kind, (bound, bound))


def _threads_of_user() -> int:
    """Return how many threads this user runs: RLIMIT_NPROC counts all of them."""
    count = 0
    for task in Path("/proc").glob("[0-9]*/task"):
        try:
            if task.stat().st_uid == os.getuid():
                count += sum(1 for _ in task.iterdir())
        except OSError:
            continue
    return count


def main(arguments: list[str]) -> int:
    """Run pytest on ``tests/`` of the present folder."""
    limit(int(arguments[0]))
    import pytest

    from amberbox.experiments.unit_tests import FOLDER

    here = str(Path.cwd())
    return int(pytest.main([
        "-c", os.devnull, "--rootdir", here, "--confcutdir", here,
        "--capture=no", "--strict-markers",
        "--continue-on-collection-errors", "-p", "amberbox.experiments.pytest_plugin",
        *(word for name in ("terminal", "logging", "warnings", "cacheprovider", "faulthandler")
          for word in ("-p", f"no:{name}")),
        *arguments[1:], FOLDER,
    ]))  # fmt: skip


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
