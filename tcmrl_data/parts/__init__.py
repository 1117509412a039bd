"""Parts and the operations that make them: a part is a function of its identity."""
