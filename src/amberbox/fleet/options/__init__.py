"""Settings that admins change while the server runs."""
