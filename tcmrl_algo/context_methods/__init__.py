"""Methods that adapt through a context."""
