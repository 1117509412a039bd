"""Datasets beyond this disk: in buckets, on the Hugging Face Hub, behind web servers."""
