"""The running server: its parts, its process, TLS, the first start."""
