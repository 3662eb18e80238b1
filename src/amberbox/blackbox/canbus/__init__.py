"""CAN: frames and what their bytes mean, for the live source and for logs of other tools."""
