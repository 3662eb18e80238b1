"""Amberbox: a flight recorder and a doctor for robots."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from amberbox.blackbox.follow.follow import follow as follow
    from amberbox.blackbox.query.record import open as open

__version__ = "0.1.0"


def __getattr__(name: str) -> Any:
    """Import ``open`` and ``follow`` when first used: ``import amberbox`` alone stays cheap."""
    if name == "open":
        from amberbox.blackbox.query.record import open as open_record

        return open_record
    if name == "follow":
        from amberbox.blackbox.follow.follow import follow as follow_record

        return follow_record
    raise AttributeError(f"module 'amberbox' has no attribute {name!r}")
