"""The agent on the robot: starts and supervises its processes, joins a server, runs the link."""
