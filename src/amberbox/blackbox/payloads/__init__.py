"""What sources share whose payloads come without a definition."""
