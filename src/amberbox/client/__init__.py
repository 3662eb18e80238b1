"""The client of a server: typed queries over its API, and a robot's record there as a Record."""
