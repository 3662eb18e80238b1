"""What robot and server say to each other: frames, positions, and the rules of both ends."""
