"""What a log cannot tell apart, by algebra: effects with the same equations, and one cause seen in two channels."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from disco_hw.effects.registry import REGISTRY
from disco_hw.gap.search.intervals import ChannelEstimates
from disco_hw.gap.settings import SelectionSettings

_MIMICS = {name: effect.mimics for name, effect in REGISTRY.items() if effect.mimics is not None}
# The cause that shows in two channels: as a gain of the drive, and as unequal wheels.
ENCODER, _SHOWN = next((name, one) for name, one in _MIMICS.items() if one.seen_too is not None)
GAIN = _SHOWN.effect.name
ASYMMETRY = _SHOWN.seen_too_as.EFFECT.name
ASYMMETRY_COLUMN = REGISTRY[ASYMMETRY].columns[0]

# What decides between the members of a class lies outside such logs.
OUTSIDE_TESTS: Mapping[frozenset[str], str] = MappingProxyType(
    {frozenset((name, mimicked.effect.name)): mimicked.decided_by for name, mimicked in _MIMICS.items()}
)


def one_encoder(
    wheels: ChannelEstimates, asymmetry: tuple[float, float], accepted: bool, settings: SelectionSettings
) -> tuple[bool, bool]:
    """Whether an encoder that counts wrong explains the wheels' gains, and whether it is the only explanation.

    An encoder's scale shows as a gain of its wheel and, with the opposite sign, as an asymmetry of half the difference;
    `asymmetry` is what the body alone tells of it, with its standard deviation, `accepted` if that is an effect of its
    own. Too small for that it still decides where it is clearly what the encoder would make it and clearly not none.
    """
    gains = [wheels.by_name.get(f"{GAIN}.{side}") for side in ("left", "right")]
    if gains[0] is None or gains[1] is None:
        return False, False
    left, right = gains[0].value, gains[1].value
    assert _SHOWN.seen_too is not None
    expected = _SHOWN.seen_too((left, right))
    spread = 0.5 * (gains[0].deviation + gains[1].deviation)
    value, deviation = asymmetry
    variance = deviation**2 + spread**2
    possible = abs(value - expected) < settings.encoder_sigmas * variance**0.5
    nats = 0.5 * (value**2 - (value - expected) ** 2) / variance
    return possible, possible and (accepted or nats > settings.encoder_nats)


def confounded_with(names: tuple[str, ...], encoder_possible: bool) -> dict[str, tuple[str, ...]]:
    """For each accepted effect what no drive can tell from it."""
    found: dict[str, tuple[str, ...]] = {}
    for other, mimicked in _MIMICS.items():
        if mimicked.effect.name in names and (mimicked.seen_too is None or encoder_possible):
            found[mimicked.effect.name] = (*found.get(mimicked.effect.name, ()), other)
    return found
