"""Symptoms over time become diagnoses: one at a time, revised as more is known."""
