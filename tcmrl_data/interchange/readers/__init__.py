"""Readers of datasets that other programs wrote, the plug-ins of `tcmrl-data import`.

Files come from strangers. A reader runs no code of theirs, follows no link out of them, and allocates no more
than a small multiple of their size.
"""
