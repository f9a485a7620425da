"""Draw scenarios: sample, resolve, trim the occluder, close the control."""
