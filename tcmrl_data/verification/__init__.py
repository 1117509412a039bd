"""Verification and repair of datasets, and removal of abandoned files."""
