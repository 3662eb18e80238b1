"""The client of a server: typed questions over its API, and a robot's record there as WHERE."""
