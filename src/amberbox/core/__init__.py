"""The words that all parts share: types, clock, configuration, expressions, plugin lookup."""
