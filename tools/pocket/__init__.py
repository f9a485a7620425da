"""The pocket model: a small video-language model trained from scratch on scenes drawn for training alone."""
