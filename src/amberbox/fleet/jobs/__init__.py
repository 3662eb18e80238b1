"""Background jobs of people: extracts that are made, kept a while, and downloaded."""
