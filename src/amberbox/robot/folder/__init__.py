"""The robot's folder on its way to the server: without its secrets."""
