"""Meta-testing: adaptation to test tasks by a protocol."""
