"""A technician's way through the pages, from the first sign of trouble to the next step."""
