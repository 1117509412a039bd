"""Datasets made from datasets: selections, unions, splits, and parts made anew from stored ones."""
