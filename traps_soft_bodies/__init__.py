"""Soft bodies for traps-pipeline: three families of a rope, a cloth and a ball, and what makes them."""
