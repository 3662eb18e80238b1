"""Memory of a worker: how much it may take, and who goes first when the machine has none left."""

from __future__ import annotations

import os
import resource
from contextlib import suppress
from pathlib import Path

_LEAST_BYTES = 2 << 30
"""What pyarrow and its threads reserve is counted, too: 1.4 GB before anything is read."""
_FIRST_TO_GO = "500"


def limit_memory(most_bytes: int) -> int:
    """Limit the memory of this process; return the limit in bytes.

    It is ``most_bytes``, but no more than half of the machine's memory, or 2 GB on small ones.
    Should the kernel need memory nevertheless, it ends this process before the server.
    """
    machine = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    limit = min(most_bytes, max(machine // 2, _LEAST_BYTES))
    resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))
    with suppress(OSError):  # a container may not let it: then the kernel chooses
        Path("/proc/self/oom_score_adj").write_text(_FIRST_TO_GO)
    return limit
