"""The source `stacked`: the SAC agents of several tasks, trained together as stacked networks."""
