"""What people read: the leaderboard as text, Markdown and one HTML file, figures, contact sheets."""
