"""Tamper evidence: the robot's key, sealed journals, signed manifest and heads, and their
verification.
"""
