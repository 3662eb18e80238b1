"""Journals on disk: MCAP files written for power cuts, and read whatever happened to them."""
