"""MACAW: adaptation by one gradient step, meta-learned through it."""
