"""MuJoCo models: shared builders, soft bodies, and simulation to a trajectory."""
