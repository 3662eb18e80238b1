"""Incidents: windows of the record that are kept, whoever or whatever wanted them."""

from typing import TYPE_CHECKING, Any

from amberbox.blackbox.incidents.budget import Refusal, held_bytes, pinned_journals
from amberbox.blackbox.incidents.incident import At, Incident, Reason, Span, load, load_all
from amberbox.blackbox.incidents.pin import Wish, advance, pin, release

if TYPE_CHECKING:
    from amberbox.blackbox.incidents.marking import mark, release_incident

__all__ = [
    "At", "Incident", "Reason", "Refusal", "Span", "Wish", "advance", "held_bytes", "load",
    "load_all", "mark", "pin", "pinned_journals", "release", "release_incident",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    """Import what reads robot folders when it is used: the keeper is at home in stores only."""
    if name in ("mark", "release_incident"):
        from amberbox.blackbox.incidents import marking

        return getattr(marking, name)
    raise AttributeError(f"module 'amberbox.blackbox.incidents' has no attribute {name!r}")
