"""Windows of data that somebody wants from a robot, delivered when it is reachable."""
