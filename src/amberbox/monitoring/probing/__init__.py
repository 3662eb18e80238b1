"""Running probes: when they look, what comes of one that hangs, and how results are published."""
