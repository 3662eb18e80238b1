"""Who may do what: people, their sessions and tokens, robots and their keys. Deny by default."""
