"""Questions to recordings: summaries, statistics, tables, plots, pictures."""
