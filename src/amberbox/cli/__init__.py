"""The command line: one verb per file, found by file name."""
