"""Behavior sources, which train the policies that collect the data."""
