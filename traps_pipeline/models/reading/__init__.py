"""Read an answer's text: its end, thinking, object and value."""
