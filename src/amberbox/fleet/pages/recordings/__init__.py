"""What robots have recorded, what of it is here, and what is taken along."""
