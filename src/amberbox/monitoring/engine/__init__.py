"""The engine: rows in, statuses and events out, the same for live data and replays."""
