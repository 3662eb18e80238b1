"""Alarms: one per root, what people did about them, and who is told."""
