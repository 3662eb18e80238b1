"""Probabilistic set covering: sets of failure modes that explain evidence, and the next test."""
