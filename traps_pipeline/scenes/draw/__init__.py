"""Draw scenarios of a family: sample, resolve, trim the occluder, close the control, redraw."""
