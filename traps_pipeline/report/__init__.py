"""Make output for people.

The leaderboard, tables, figures, contact sheets and the report page.
"""
