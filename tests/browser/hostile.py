"""Names and texts that must be escaped wherever a page shows them."""

from __future__ import annotations

from collections.abc import Sequence

MARKUP = '<img src=x onerror="document.title=1">'
SCRIPT = '"><script>document.title=1</script>'
TEMPLATE = "{{7*7}} ${7*7} ';--"
BACKWARDS = "\u202eflesti\u202c itself"
"""Written from right to left by a mark that turns what follows."""

COMPONENT = f"arm {MARKUP}"
"""A component of ``ropod_002``."""
OUTPUT = SCRIPT
"""An output of that component."""
MODEL = f"Ropod 2 {MARKUP}"
"""What the folder of ``ropod_002`` calls its model."""
ITEM = "hostile"
"""A data item of ``ropod_001`` with variables at the paths ``FIELDS`` that hold ``TEXTS``."""
FIELDS: Sequence[str] = (MARKUP.replace('"', ""), BACKWARDS)
TEXTS: Sequence[str] = (MARKUP, SCRIPT, TEMPLATE, BACKWARDS)
MISSION = f"transport {MARKUP}"
"""Name of the mission ``transport-2`` of ``ropod_001``."""
NOTE = f"{SCRIPT} {BACKWARDS}"
"""A note on the acknowledged alarm, and its reason."""
EVENT = f"somebody said {SCRIPT}"
"""An event of ``ropod_002``."""
