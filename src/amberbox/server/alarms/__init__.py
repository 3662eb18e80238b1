"""Alarms, one per root cause, with their lifecycle, and the notifications sent about them."""
