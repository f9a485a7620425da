"""Build MuJoCo models, with soft bodies, and simulate them to trajectories."""
