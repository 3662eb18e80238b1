"""Incidents: windows of the record that are kept, whoever or whatever wanted them."""

from amberbox.blackbox.incidents.budget import Refusal, held_bytes, pinned_journals
from amberbox.blackbox.incidents.incident import At, Incident, Reason, Span, load, load_all
from amberbox.blackbox.incidents.mark import mark, release_incident
from amberbox.blackbox.incidents.pin import Wish, advance, pin, release

__all__ = [
    "At", "Incident", "Reason", "Refusal", "Span", "Wish", "advance", "held_bytes", "load",
    "load_all", "mark", "pin", "pinned_journals", "release", "release_incident",
]  # fmt: skip
