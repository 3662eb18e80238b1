"""Worker processes that run long or risky operations under limits of time and memory."""
