"""Check machine, requests and endpoints before money is spent."""
