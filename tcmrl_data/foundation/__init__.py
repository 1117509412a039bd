"""What everything stands on: errors, seeds, canonical JSON, safe file operations, plug-ins."""
