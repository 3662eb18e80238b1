"""Diagnosis of a robot from its folder and its record: knowledge, context, lookups for rules."""
