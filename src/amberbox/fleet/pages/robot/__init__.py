"""The page of a robot: how it is, live."""
