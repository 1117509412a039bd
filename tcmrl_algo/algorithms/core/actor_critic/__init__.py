"""The offline actor-critics under every method that adapts through a context."""
