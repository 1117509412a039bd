"""Protocols of adaptation, one a file."""
