"""Journal files: MCAP that survives power cuts, and readers for files in any state."""
