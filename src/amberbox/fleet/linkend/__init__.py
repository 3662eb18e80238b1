"""The server's end of the link: rows are stored once, acknowledged when durable, and shown."""
