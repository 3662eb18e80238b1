"""Commands: what a person or a run wants a robot to do."""

from __future__ import annotations

from typing import Literal

Risk = Literal["record", "state", "moves"]
RISKS: tuple[Risk, ...] = ("record", "state", "moves")
"""The risks in ascending order."""
