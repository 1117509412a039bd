"""Networks and their optimiser: torch alone."""
