"""Structural analysis: what a set of equations can detect and isolate, and which tests it has."""
