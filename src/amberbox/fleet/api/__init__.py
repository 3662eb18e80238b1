"""The HTTP API: one room's routes per file, each judged by the table of actions."""
