"""Amberbox: a flight recorder and a doctor for robots."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from amberbox.blackbox.follow.follow import follow as follow
    from amberbox.blackbox.incidents.marking import mark as mark
    from amberbox.client.opening import open as open

__version__ = "0.1.0"


def __getattr__(name: str) -> Any:
    """Import the rest when it is first used: ``import amberbox`` alone stays cheap."""
    if name == "open":
        from amberbox.client.opening import open as open_record

        return open_record
    if name == "follow":
        from amberbox.blackbox.follow.follow import follow as follow_record

        return follow_record
    if name == "mark":
        from amberbox.blackbox.incidents.marking import mark as mark_incident

        return mark_incident
    raise AttributeError(f"module 'amberbox' has no attribute {name!r}")
