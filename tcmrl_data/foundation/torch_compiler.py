"""Processes that compile nothing need not wait for torch's compiler.

Making or stepping an optimiser imports `torch._dynamo`, to tell the compiler where a graph has to break. This
takes two seconds, in every worker and at the start of every training.
"""

import importlib
import sys
from collections.abc import Callable
from types import ModuleType
from typing import Any

COMPILER = "torch._dynamo"


class _StandIn(ModuleType):
    """Answers what optimisers ask of the compiler; whoever asks for more gets the compiler itself."""

    @staticmethod
    def disable(function: Callable[..., Any], *options: Any, **named: Any) -> Callable[..., Any]:
        return function

    @staticmethod
    def graph_break(reason: str = "") -> None:
        pass

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") and name != "__path__":  # `inspect` looks for `__file__` in every module
            raise AttributeError(name)
        if sys.modules.get(COMPILER) is self:
            del sys.modules[COMPILER]
        return getattr(importlib.import_module(COMPILER), name)


def leave_out_compiler() -> None:
    """Keeps torch from importing its compiler before something is compiled.

    For whole programs; a library must not do this to the programs that import it.
    """
    sys.modules.setdefault(COMPILER, _StandIn(COMPILER))
