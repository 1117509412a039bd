"""Environment families, one a file; each module maps names to classes in ENVIRONMENTS."""
