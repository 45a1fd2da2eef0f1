"""Pose sources, one file each, of which robot.toml's `pose.source` names one; see docs/add-a-pose-source.md."""

from __future__ import annotations

import inspect
import pkgutil
from collections.abc import Callable, Mapping
from functools import cache
from importlib import import_module
from types import MappingProxyType
from typing import Any

from drivers.pose import robot
from drivers.pose.convention import PoseSourceError
from drivers.types import PoseSource

__all__ = ["DEFAULT", "PoseSourceError", "find_pose_source", "make_pose_source", "own_fields", "pose_sources"]

DEFAULT = robot.SOURCE


@cache
def pose_sources() -> Mapping[str, Callable[..., PoseSource]]:
    """By name: the `make_pose_source` of each module in this folder that has a `SOURCE`.

    It makes a source of the fields of [pose], of which it takes its own and leaves the others.
    """
    modules = (import_module(each.name) for each in pkgutil.iter_modules(__path__, f"{__name__}."))
    return MappingProxyType({module.SOURCE: module.make_pose_source for module in modules if hasattr(module, "SOURCE")})


def find_pose_source(name: str) -> Callable[..., PoseSource]:
    """Return what makes the source of this name. Raises PoseSourceError for a name not known."""
    known = pose_sources()
    if name not in known:
        raise PoseSourceError(f'there is no source "{name}"; write one of {", ".join(known)}')
    return known[name]


def own_fields(name: str) -> frozenset[str]:
    """The fields of [pose] that the source of this name takes, and others may not. Raises PoseSourceError."""
    parameters = inspect.signature(find_pose_source(name)).parameters.values()
    return frozenset(each.name for each in parameters if each.kind is inspect.Parameter.KEYWORD_ONLY)


def make_pose_source(source: str, **fields: Any) -> PoseSource:
    """Make the source that `pose.source` names of the fields of [pose]; None is a default. Raises PoseSourceError."""
    return find_pose_source(source)(**{name: value for name, value in fields.items() if value is not None})
