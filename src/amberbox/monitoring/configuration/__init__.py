"""Component and mode files: read, bound to what is recorded, and judged."""
