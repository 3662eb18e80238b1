"""Statuses as messages for others: the paper's JSON, HEALTH-STATUS, DiagnosticArray."""
