"""The source `stacked`: many agents of Stable-Baselines3's SAC as one stack of networks."""
