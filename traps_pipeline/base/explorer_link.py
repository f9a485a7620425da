"""Address the explorer of all answers, to which the report and Dagster's pages link."""

from urllib.parse import urlencode

EXPLORER = "index.html"  # path beside the report page


def answers_view(**filters: str) -> str:
    """Return the view (the address after `#`) of the answers of these cells; an empty filter means all."""
    query = urlencode({name: value for name, value in filters.items() if value})
    return f"/answers?{query}" if query else "/answers"
