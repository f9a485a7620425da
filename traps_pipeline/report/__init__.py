"""Make output for people: leaderboard, tables, figures, explorer and report page."""
