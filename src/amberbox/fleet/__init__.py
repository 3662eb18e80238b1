"""The server of a fleet: what robots send it, who may see it, and what was done with it."""
