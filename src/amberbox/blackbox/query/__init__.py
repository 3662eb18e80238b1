"""Queries of a record: rows, gaps, SQL, overview, export, import, Foxglove."""
