"""The robot folder: ``robot.yaml`` and ``black_box.yaml`` read into checked options."""
