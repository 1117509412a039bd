"""Methods, one a file: each has NAME, a frozen Config, and create(problem, settings, config) -> Algorithm."""
