"""Questions about what robots have recorded: rows, items, gaps, missions, incidents, journals."""

WORKER = "amberbox.fleet.data.worker"
"""Where the operations are that ``Asking`` calls."""
