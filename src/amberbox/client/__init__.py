"""The client of a server: typed queries over its API, and a robot's record on it as a Record."""
