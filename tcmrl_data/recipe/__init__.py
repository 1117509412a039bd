"""Recipes and the tasks they describe."""
