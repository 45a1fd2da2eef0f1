"""How near each threshold of the search comes to deciding otherwise: one search that follows half and double of each.

`watched` puts numbers into settings that behave as before, and carry what they would be with a threshold at half and at
double. A comparison that would come out otherwise is counted as a flip. Arithmetic of single numbers is followed. Where
half or double changes an array or a number that is not followed further, it is counted as lost: it may matter.

A threshold without either changes nothing in this log: the search takes the same steps with half and with double of it.
What the C side of Python reads (`math.log(threshold)`) is not seen; `ablation` therefore checks all such thresholds
together, at half and at double.
"""

from __future__ import annotations

import operator
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from disco_hw.gap.settings import DEFAULT_SETTINGS, GapSettings

FACTORS = (0.5, 2.0)
_COMPARISONS = ("lt", "le", "gt", "ge", "eq", "ne")
_ARITHMETIC = ("add", "sub", "mul", "truediv", "floordiv", "mod", "pow")


@dataclass
class Margins:
    """Counts by threshold: how often it was compared, how often half or double flips that, how often it was lost."""

    compared: Counter[str] = field(default_factory=Counter)
    flipped: Counter[str] = field(default_factory=Counter)
    lost: Counter[str] = field(default_factory=Counter)

    def matter(self, name: str) -> bool:
        """Whether a threshold may change anything: it flips or is lost, or was never seen in a comparison."""
        return bool(self.flipped[name] or self.lost[name] or not self.compared[name])


class _Watched:
    """What numbers of both kinds share: other values by threshold, at half and at double, and the margins."""

    others: Mapping[str, tuple[Any, Any]]
    margins: Margins


class WatchedFloat(float, _Watched):
    """A float that carries what it would be with thresholds at half and at double."""

    __hash__ = float.__hash__

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: Any, **named: Any) -> Any:
        return _evaluate(lambda *values: getattr(ufunc, method)(*values, **named), inputs, _is_comparison(ufunc))

    def __round__(self, digits: int | None = None) -> Any:  # type: ignore[override]
        return _evaluate(lambda value: round(value) if digits is None else round(value, digits), (self,), False)

    def __int__(self) -> int:
        return int(_evaluate(int, (self,), False))


class WatchedInt(int, _Watched):
    """The same of a whole number."""

    __hash__ = int.__hash__

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: Any, **named: Any) -> Any:
        return _evaluate(lambda *values: getattr(ufunc, method)(*values, **named), inputs, _is_comparison(ufunc))


def _is_comparison(ufunc: np.ufunc) -> bool:
    return ufunc in (np.less, np.less_equal, np.greater, np.greater_equal, np.equal, np.not_equal)


def _plain(value: Any) -> Any:
    return (
        float(value.real)
        if isinstance(value, WatchedFloat)
        else int(value.real)
        if isinstance(value, WatchedInt)
        else value
    )


def _evaluate(function: Callable[..., Any], inputs: tuple[Any, ...], is_comparison: bool) -> Any:
    """Evaluate a function of numbers, some of them watched, as usual and with each threshold at half and double."""
    usual = function(*map(_plain, inputs))
    watched = [value for value in inputs if isinstance(value, _Watched)]
    margins, others = watched[0].margins, dict[str, tuple[Any, Any]]()
    for name in sorted({name for value in watched for name in value.others}):
        pair: list[Any] = []
        for place in (0, 1):
            values = [
                value.others[name][place] if isinstance(value, _Watched) and name in value.others else _plain(value)
                for value in inputs
            ]
            with np.errstate(all="ignore"):
                pair.append(function(*values))
        if is_comparison:
            margins.compared[name] += 1
            margins.flipped[name] += any(not np.array_equal(one, usual) for one in pair)
        else:
            others[name] = (pair[0], pair[1])
    if is_comparison or not others:
        return usual
    if isinstance(usual, (float, int)) and not isinstance(usual, bool):
        return watched_number(usual, others, margins)
    for name, pair in others.items():
        margins.lost[name] += any(not np.array_equal(one, usual) for one in pair)
        margins.compared[name] += 1
    return usual


def watched_number(value: float, others: Mapping[str, tuple[Any, Any]], margins: Margins) -> Any:
    """Return a number that behaves as `value` and carries others."""
    # A float of numpy is one of Python, too.
    number: Any = WatchedInt(value) if isinstance(value, int) else WatchedFloat(value)
    number.others, number.margins = others, margins
    return number


def _install() -> None:
    for kind in (WatchedFloat, WatchedInt):
        for name in (*_COMPARISONS, *_ARITHMETIC):
            by, compares = getattr(operator, name), name in _COMPARISONS

            def forward(self: Any, other: Any, by: Any = by, compares: bool = compares) -> Any:
                if not isinstance(other, (int, float, np.ndarray, np.generic)):
                    return NotImplemented
                return _evaluate(by, (self, other), compares)

            def backward(self: Any, other: Any, by: Any = by) -> Any:
                if not isinstance(other, (int, float, np.ndarray, np.generic)):
                    return NotImplemented
                return _evaluate(by, (other, self), False)

            setattr(kind, f"__{name}__", forward)
            if not compares:
                setattr(kind, f"__r{name}__", backward)
        for name in ("neg", "abs"):
            sign = getattr(operator, name)
            setattr(kind, f"__{name}__", lambda self, sign=sign: _evaluate(sign, (self,), False))


_install()


def watched() -> tuple[GapSettings, Margins]:
    """Return the usual settings with every number watched, and the margins that a search with them fills."""
    margins, groups = Margins(), {}
    for group in fields(DEFAULT_SETTINGS):
        of, numbers = getattr(DEFAULT_SETTINGS, group.name), {}
        for one in fields(of):
            value = getattr(of, one.name)
            if isinstance(value, (float, int)):
                at = [max(round(value * by), 1) if isinstance(value, int) else value * by for by in FACTORS]
                numbers[one.name] = watched_number(value, {f"{group.name}.{one.name}": (at[0], at[1])}, margins)
        groups[group.name] = replace(of, **numbers)
    return replace(DEFAULT_SETTINGS, **groups), margins
