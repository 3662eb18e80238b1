"""Make a robot folder report to a server, by the line that the server gave."""
