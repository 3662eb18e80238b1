"""Tamper evidence: what of a store is as the robot left it, and what is not."""
