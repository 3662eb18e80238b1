"""Sources: one file for each bus or kind of recording the box can listen to."""
