"""The level above robots: teams and the system, watched on the server."""
