"""Tables of cases and examples, of which `make test` runs a few and `make test-all` runs all."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import pytest
from hypothesis import given, settings


def thinned(names: str | Sequence[str], cases: Sequence[Any], *, quick: int, **options: Any) -> pytest.MarkDecorator:
    """Parametrize a test with all cases and mark all but `quick` of them `thorough`.

    The quick ones are spread evenly over the table, from the first to the last. For what follows from two arguments,
    thin both: then each quick value of one meets each quick value of the other.
    """
    cases = list(cases)
    quick = min(quick, len(cases))
    kept = {round(i * (len(cases) - 1) / max(quick - 1, 1)) for i in range(quick)}
    single = isinstance(names, str) and "," not in names
    parameters = [case if at in kept else _thorough(case, single) for at, case in enumerate(cases)]
    return pytest.mark.parametrize(names, parameters, **options)


def examples(*, quick: int, every: int, **strategies: Any) -> Callable[[Callable[..., None]], Callable[[int], None]]:
    """Make a test of a property, which takes these strategies' values: `make test` tries `quick` examples of it."""

    def decorate(test: Callable[..., None]) -> Callable[[int], None]:
        tried = {count: settings(max_examples=count)(given(**strategies)(test)) for count in (quick, every)}

        @pytest.mark.parametrize("count", [quick, pytest.param(every, marks=pytest.mark.thorough)])
        def run(count: int) -> None:
            tried[count]()

        run.__name__, run.__qualname__, run.__doc__ = test.__name__, test.__qualname__, test.__doc__
        run.__module__ = test.__module__
        return run

    return decorate


def _thorough(case: Any, single: bool) -> Any:
    """Mark one case `thorough`; `single`: the table has one argument, so that a tuple is its value."""
    if hasattr(case, "marks"):
        return pytest.param(*case.values, marks=[*case.marks, pytest.mark.thorough], id=case.id)
    return pytest.param(*([case] if single else case), marks=pytest.mark.thorough)
