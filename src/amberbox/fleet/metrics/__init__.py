"""The server's own figures, in the text form that Prometheus reads."""
