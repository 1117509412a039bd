"""Tuning: the same number of trials for every method, scored on held-out training tasks."""
