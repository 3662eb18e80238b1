"""The page that says what is broken, and all it rests on."""
