"""What other engines find, made ready for the one answer."""
