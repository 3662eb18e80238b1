"""The page of a robot's data."""
