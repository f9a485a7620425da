"""A person's work with a study: write an experiment, plan it, read its status, and import answers from elsewhere."""
