"""Filters: decide before the journal whether a whole message is kept."""
