"""A dataset on disk: archives, arrays, tables, manifest, records."""
