"""Retention of the record: deletion by one rule, incidents, triggers, missions, and the
maintenance process."""
