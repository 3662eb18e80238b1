"""Secrets in settings: shown as ``***``, and kept when ``***`` comes back."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from amberbox.core.errors import UsageError
from amberbox.core.redaction import MASK, sounds_secret
from amberbox.fleet.options.vault import LOST


def masked(value: Any) -> Any:
    """Return what JSON can hold, with secrets masked that are not empty; lost ones are empty."""
    if isinstance(value, Mapping):
        return {key: _cover(key, inner) for key, inner in value.items()}
    return [masked(inner) for inner in value] if isinstance(value, list | tuple) else value


def unmasked(value: Any, before: Any) -> Any:
    """Put secrets back where somebody returned the mask: those at the same place before.

    Raises UsageError where there was none, or it would go to another host or address now.
    """
    if isinstance(value, Mapping):
        old = before if isinstance(before, Mapping) else {}
        if any(key in value and value[key] != old.get(key) for key in ("host", "url")):
            old = {}  # it goes elsewhere now: whoever changed that has to know the secret
        return {key: _uncover(key, inner, old.get(key)) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        held = list(before) if isinstance(before, list | tuple) else []
        held += [None] * (len(value) - len(held))
        return [unmasked(inner, old) for inner, old in zip(value, held, strict=False)]
    return value


def _cover(key: str, value: Any) -> Any:
    if not (sounds_secret(key) and isinstance(value, str) and value):
        return masked(value)
    return "" if value == LOST else MASK


def _uncover(key: str, value: Any, before: Any) -> Any:
    if sounds_secret(key) and value == MASK:
        if isinstance(before, str) and before and before != LOST:
            return before
        raise UsageError(
            f"the {key} is masked, and there is none to keep",
            "write it again: it is new, or goes to another host or address now",
        )
    return unmasked(value, before)
