"""A store on the Foxglove WebSocket protocol, live or played back, for viewers of that protocol."""
