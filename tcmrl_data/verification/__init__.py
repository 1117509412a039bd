"""What `verify.py` looks with, and what follows from its findings: repair and the collection of garbage."""
