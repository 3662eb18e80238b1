"""The archive: what robots have recorded, kept on the server; journals, columns, and queries."""
