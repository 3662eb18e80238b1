"""The thread that copies journals, one after the other, while there is a link and a reason to."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, field

from amberbox.core.errors import AmberboxError
from amberbox.link.backoff import Backoff
from amberbox.robot.link.copying import Copier, CopyError
from amberbox.robot.link.fetching import Requests

POLL_S = 2.0


@dataclass(slots=True)
class CopyLoop:
    """Copies what is due; ``before`` is done first each time, for what else goes by HTTP.

    ``may_copy`` tells whether anything may be copied now.
    """

    copier: Copier
    requests: Requests
    before: Callable[[], None]
    may_copy: Callable[[], bool]
    backoff: Backoff = field(default_factory=Backoff)
    trouble: str = ""
    copied: int = 0
    wake: threading.Event = field(default_factory=threading.Event)

    def run(self) -> None:
        """Work until the copier's ``stop`` is set."""
        stop = self.copier.stop
        while not stop.is_set():
            try:
                worked = self.step()
            except (CopyError, AmberboxError, OSError) as error:
                self.trouble = str(error).splitlines()[0]
                stop.wait(self.backoff.failed())
            else:
                self.backoff.succeeded()
                self.trouble = ""
                self._rest(worked=worked)

    def step(self) -> bool:
        """Do the next thing; tell whether there was one. Raises what may pass by itself."""
        self.requests.step()
        if not self.may_copy():
            return False
        self.before()
        worked = self.copier.step()
        self.copied += worked
        return worked

    def _rest(self, *, worked: bool) -> None:
        if not worked:
            self.wake.wait(POLL_S)
            self.wake.clear()
