"""Output for people: the leaderboard, tables, figures, contact sheets and the report page."""
