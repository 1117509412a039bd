"""Environment families, one per file; plug-ins of the entry point group `tcmrl.environments`."""
