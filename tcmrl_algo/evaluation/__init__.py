"""Meta-testing: protocols that adapt a trained policy to test tasks, and its evaluation."""
