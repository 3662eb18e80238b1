"""A worker of the archive that fails at items of certain names, as one does at a bomb.

``python -m tests.server.archive.deadly DIR NICE``: an item ``kills`` ends the process, ``lasts``
never ends.
"""

from __future__ import annotations

import os
import signal
import time
from typing import Any

from amberbox.server.archive import commit
from amberbox.server.workers.process import main

_flats_of = commit.flats_of


def deadly(journal: Any, *arguments: Any) -> Any:
    """Unroll a journal, or fail at one of its items."""
    names = {stream.item for stream in journal.streams.values()}
    if "kills" in names:
        os.kill(os.getpid(), signal.SIGKILL)
    while "lasts" in names:
        time.sleep(1)
    return _flats_of(journal, *arguments)


if __name__ == "__main__":
    setattr(commit, "flats_of", deadly)  # noqa: B010  # it is what the test is about
    main()
