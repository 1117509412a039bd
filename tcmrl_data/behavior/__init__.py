"""Behavior sources: what trains the policies that data come from."""
