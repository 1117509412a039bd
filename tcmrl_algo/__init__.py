"""tcmrl_algo meta-trains on datasets of tcmrl_data and adapts to unseen tasks.

The whole public API stands in `__init__.pyi`; a name is imported when it is first used, so that
`tcmrl --help` needs no torch.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
