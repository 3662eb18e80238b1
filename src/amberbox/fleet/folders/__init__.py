"""Robots' folders as they were, by their hash, without secrets."""
