"""Component and mode files: read, bound to what is recorded, and judged."""

from __future__ import annotations

from amberbox.monitoring.configuration.load import load_plan

__all__ = ["load_plan"]
