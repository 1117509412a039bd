"""The installed methods, one per file: a `Method` with its settings and its learner."""
