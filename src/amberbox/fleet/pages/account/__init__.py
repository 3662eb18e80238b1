"""Who one is: the first admin, signing in, one's own account."""
