"""Play recorded messages to peers: the pace, and one file for each kind of peer."""
