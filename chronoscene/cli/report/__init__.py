"""Commands that read finished runs: tables, comparisons, trade-offs, the leaderboard."""
