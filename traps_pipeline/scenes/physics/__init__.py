"""MuJoCo models: the builders that families share, soft bodies, and simulation to a trajectory."""
