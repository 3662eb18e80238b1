"""The demonstration: a server, three simulated robots with faults, and a scripted story."""
