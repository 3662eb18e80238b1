"""Message formats in which statuses are published, one file each."""
