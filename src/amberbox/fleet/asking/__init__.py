"""Questions that take long or must be limited: workers with a limit of time and memory."""
