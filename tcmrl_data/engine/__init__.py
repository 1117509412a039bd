"""Engines run units somewhere: units in, results out; they know no dataset."""
