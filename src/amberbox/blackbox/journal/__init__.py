"""Journal files: MCAP written for power cuts, and read in whatever state they are."""
