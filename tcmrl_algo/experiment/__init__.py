"""Experiments: methods × environments × seeds, run several at once, resumable, in one results folder."""
