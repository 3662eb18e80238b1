"""What the benchmarks of the feed have in common: robots that talk, a server, people who look."""
