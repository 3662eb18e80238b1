"""What was done on the server, by whom: rows that follow on one another and are never changed."""
