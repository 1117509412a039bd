"""What is in a dataset: scores, coverage, rewards, how policies transfer, and what a context is worth."""
