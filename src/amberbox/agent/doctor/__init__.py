"""The doctor: checks whether a computer is fit to record, and for how long."""
