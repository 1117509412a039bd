"""Meta-training: a dataset and a configuration in, a run's folder out."""
