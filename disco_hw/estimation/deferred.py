"""Importing a package without those of its dependencies that are not going to be used."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType
from typing import Any


@contextmanager
def deferred(*names: str) -> Iterator[None]:
    """Put off the import of these modules by what the block imports, until something of them is called.

    What the block takes from them by `from NAME import THING` is a stand-in for that function or object. Whoever
    imports the modules afterwards gets them as ever. Nothing happens to one that is imported already.
    """
    put_off = {name: _DeferredModule(name) for name in names if name not in sys.modules}
    sys.modules.update(put_off)
    try:
        yield
    finally:
        for name in put_off:
            del sys.modules[name]


class _DeferredModule(ModuleType):
    """A module as it is seen by an import statement: everything is in it."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return _DeferredThing(self.__name__, name)


class _DeferredThing:
    """Something of a module; using it imports the module."""

    def __init__(self, module: str, name: str) -> None:
        self._source = module, name

    def __getattr__(self, name: str) -> Any:
        return getattr(self._thing(), name)

    def __call__(self, *arguments: Any, **named: Any) -> Any:
        return self._thing()(*arguments, **named)

    def _thing(self) -> Any:
        module, name = self._source
        return getattr(importlib.import_module(module), name)
