"""Packages that only some formats need."""

import importlib
from collections.abc import Sequence

from tcmrl_data.foundation.errors import MissingPackageError


def require_packages(what: str, packages: Sequence[str], extra: str | None) -> None:
    """Imports packages.

    Args:
        what: needs them, such as `format 'minari'`.
        packages: names of modules.
        extra: what installs them, such as `tcmrl[minari]`; the modules' own names where None.

    Raises:
        MissingPackageError: one of them cannot be imported.
    """
    try:
        for package in packages:
            importlib.import_module(package)
    except ImportError as error:
        raise MissingPackageError(
            f"{what} needs a package that is missing ({error}); pip install '{extra or ' '.join(packages)}'"
        ) from None
