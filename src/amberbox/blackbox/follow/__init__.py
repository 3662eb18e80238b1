"""Rows out of journals, in order and with a cursor: what everything behind the recorder reads."""
