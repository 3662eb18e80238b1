"""Changes as they happen, for browsers and programs, and the server's own figures."""
