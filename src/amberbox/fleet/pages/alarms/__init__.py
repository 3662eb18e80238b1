"""The list of alarms, and the page of one."""
