"""The HTTP API. One router per file, every route guarded by an action of the permission table."""
