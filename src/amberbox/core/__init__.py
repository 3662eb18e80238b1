"""What all parts share: types, errors, clock, configuration, expressions, contracts of plugins."""
