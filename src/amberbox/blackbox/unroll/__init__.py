"""Unrolling: messages of any type become flat, typed columns, compiled from their definition."""
