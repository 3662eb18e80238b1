"""Queries over recorded data.

Rows, items, gaps, missions and incidents, answered by worker processes.
"""
