"""Tables of a run's settings: validated values alone."""
