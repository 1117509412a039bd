"""A dataset on disk: arrays, records, layout."""
