"""Work on an archive that is killed at chosen moments: ``python -m ... FOLDER SEED COUNT``.

Each attempt is a process of its own (forked before any library has threads): it commits, joins,
deletes and sweeps, and kills itself with SIGKILL at a random one of the steps that change anything
on disk, before or after it. Prints how many attempts were killed; the last one is left to finish.
"""

from __future__ import annotations

import os
import random
import signal
import sys
import time
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

from amberbox.core.clock import NS
from amberbox.server.archive import catalogue, commit, delta_files, folder
from amberbox.server.journals import OWN, Retention

RULES = [Retention("old", "*", columns_s=0, journals_s=0), Retention("old", OWN, columns_s=1e12)]
_LATER_NS = 2 * 24 * 3600 * NS
_STEPS = (
    (catalogue.ArchiveCatalogue, ("plan", "register", "finish", "change")),
    (delta_files.ArchiveFile, ("write", "finish")),
    (Path, ("unlink", "rename")),
)


class Fate:
    """Counts steps and ends the process at one of them."""

    def __init__(self, last: int, *, after: bool) -> None:
        self.left = last
        self.after = after

    def step(self, do: Callable[..., Any]) -> Callable[..., Any]:
        """Wrap a step."""

        def stepped(*arguments: Any, **named: Any) -> Any:
            self.left -= 1
            if self.left == 0 and not self.after:
                os.kill(os.getpid(), signal.SIGKILL)
            answer = do(*arguments, **named)
            if self.left == 0:
                os.kill(os.getpid(), signal.SIGKILL)
            return answer

        return stepped


def work(where: Path, fate: Fate | None) -> None:
    """Do everything that there is to do, in small batches."""
    commit.BATCH_BYTES = 20_000
    commit.COUNT = 2
    if fate is not None:
        delta_files.change_table = fate.step(delta_files.change_table)
        for owner, names in _STEPS:
            for name in names:
                setattr(owner, name, fate.step(getattr(owner, name)))
    archive = folder.FolderArchive(where)
    for _ in range(50):
        archive.compact()
        if not archive.commit(0.0).journals:
            break
    archive.retain(RULES, time.time_ns() + _LATER_NS)  # what has come is old by then
    archive.compact()
    archive.sweep()


def attempt(where: Path, fate: Fate | None) -> int:
    """Work in a process of its own; return how it ended."""
    child = os.fork()
    if child == 0:
        code = 70
        try:
            work(where, fate)
            code = 0
        finally:
            sys.stderr.flush()
            if code:
                sys.excepthook(*sys.exc_info())
            os._exit(code)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def main() -> None:
    """Run the attempts. Modules imported here are not imported again by each of them."""
    for library in ("pyarrow.parquet", "pandas", "deltalake"):
        import_module(library)
    where, chance, count = Path(sys.argv[1]), random.Random(int(sys.argv[2])), int(sys.argv[3])
    ends = [
        attempt(where, Fate(chance.randint(1, 40), after=chance.random() < 0.5))
        for _ in range(count)
    ]
    ends.append(attempt(where, None))
    print(*ends)
    os._exit(0)


if __name__ == "__main__":
    main()
