"""The live feed that pushes changes to browsers and programs over a WebSocket."""
