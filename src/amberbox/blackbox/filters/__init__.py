"""Filters: decide before the journal whether a message is kept; images are made smaller."""
