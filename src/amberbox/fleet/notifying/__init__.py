"""Tell people of alarms: e-mail and webhooks, each once, through an outbox that survives."""
