"""The robot's word for its record: its key, sealed journals, the signed manifest, signed heads."""
