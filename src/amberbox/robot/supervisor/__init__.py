"""What ``amberbox run`` does: start the box's processes, watch over them, start them again."""
