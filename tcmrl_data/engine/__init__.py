"""Engines run units of work in processes and return their results; they know nothing of datasets."""
