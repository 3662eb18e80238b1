"""Deletion by one rule: what the store holds, what goes next, tombstones first, then the files."""
