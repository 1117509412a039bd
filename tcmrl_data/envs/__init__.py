"""Environment families, one a file; plug-ins of the entry point group `tcmrl.environments`."""
