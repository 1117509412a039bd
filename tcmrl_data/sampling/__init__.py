"""What `sampler.py` is made of: packed rows in memory or in the cache, draws, gathers, prefetching."""
