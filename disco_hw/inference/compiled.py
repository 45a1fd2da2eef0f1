"""Compiled loops of this package that run side by side in threads."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from disco_hw.jit import kernel_function


def parallel_kernel(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile an entry point as the model does, without the interpreter's lock while it runs."""
    kernel: Any = kernel_function(function)
    kernel.targetoptions["nogil"] = True
    compiled: Callable[..., Any] = kernel
    return compiled
