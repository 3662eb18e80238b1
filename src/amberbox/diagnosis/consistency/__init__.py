"""Consistency-based diagnosis: which modes of components agree with what was observed."""
