"""What robots concluded: from the archive's columns and from the link, each record once."""
