"""Diagnoses of robots, and questions to their fault trees, failure modes and rules."""
