"""Providers of evidence: what monitors, conditions, rules, users and fault trees contribute."""
