"""What robots know before anything breaks."""
