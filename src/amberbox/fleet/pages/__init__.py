"""The web interface: one file per page, its templates, its words, and what runs in the browser."""
