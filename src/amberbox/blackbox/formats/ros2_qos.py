"""Whether a ROS 2 topic is latched, from the quality of service its publishers offered."""

from __future__ import annotations

from typing import Any

import yaml

_TRANSIENT_LOCAL = (1, "transient_local")  # as a number up to metadata version 8, then as a word


def is_latched(profiles: Any) -> bool:
    """Tell whether any offered profile is transient local; ``profiles`` is YAML text or a list."""
    if isinstance(profiles, str):
        profiles = _parse(profiles)
    if not isinstance(profiles, list):
        return False
    return any(isinstance(p, dict) and p.get("durability") in _TRANSIENT_LOCAL for p in profiles)


def _parse(text: str) -> Any:
    try:
        return yaml.safe_load(text)
    except yaml.YAMLError:
        return None
