"""Amberbox: a flight recorder and a doctor for robots."""

import sys
from typing import TYPE_CHECKING, Any

from amberbox.core.moved import Moved
from amberbox.core.version import __version__ as __version__

if TYPE_CHECKING:
    from amberbox.blackbox.retention.pins import mark as mark
    from amberbox.blackbox.store.tail import follow as follow
    from amberbox.client.opening import open as open
    from amberbox.core.event_log import log as log

sys.meta_path.append(Moved())


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used, so that ``import amberbox`` alone stays fast."""
    if name == "open":
        from amberbox.client.opening import open as open_record

        return open_record
    if name == "follow":
        from amberbox.blackbox.store.tail import follow as follow_record

        return follow_record
    if name == "mark":
        from amberbox.blackbox.retention.pins import mark as mark_incident

        return mark_incident
    if name == "log":
        from amberbox.core.event_log import log as log_event

        return log_event
    raise AttributeError(f"module 'amberbox' has no attribute {name!r}")
