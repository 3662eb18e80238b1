"""The demonstration: a server, three simulated robots that may be broken, and the story of it."""
