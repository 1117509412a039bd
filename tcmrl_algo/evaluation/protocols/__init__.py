"""Protocols of adaptation, one per file."""
