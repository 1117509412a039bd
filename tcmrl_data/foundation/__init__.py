"""Shared foundations: errors, seeds, canonical JSON, safe file operations and plug-ins."""
