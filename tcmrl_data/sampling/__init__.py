"""Sampling of meta-training batches: packed rows in memory or in the cache, draws, gathers, prefetching."""
