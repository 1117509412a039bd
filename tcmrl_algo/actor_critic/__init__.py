"""The offline actor-critic that context-based methods share."""
