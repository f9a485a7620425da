"""Local web pages: the review of scenarios, and labels by people."""
