"""The web interface: pages with their templates, texts and browser modules."""
