"""The doctor of the box: is it fit to record, for how long, and what would make it better."""
