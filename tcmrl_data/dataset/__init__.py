"""Reading a dataset: parts, selections, tables of returns."""
