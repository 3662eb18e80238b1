"""Questions to a record: items, rows of a time range, gaps, events, SQL."""
