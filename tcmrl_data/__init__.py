"""tcmrl_data makes, keeps and serves datasets for offline meta-reinforcement learning.

The whole public API stands in `__init__.pyi`; a name is imported when it is first used, so that looking at a
dataset needs neither torch nor Stable-Baselines3.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
