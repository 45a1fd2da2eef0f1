"""Rare events: a start that comes late, wheels that are blocked, a slip, as in none of the rest of a log.

They are found in what the final fit leaves, and change no fit.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from disco_hw.effects import Channel
from disco_hw.gap.noise.channels import WheelChannel
from disco_hw.gap.report.scan import Windows, scan
from disco_hw.gap.search.channel_result import ChannelResult
from disco_hw.gap.settings import GRID_STEP_S

_SIDES = ("left", "right")
_YAW = 2


@dataclass(frozen=True, slots=True)
class RareEvent:
    """A rare event: when it began and how long it lasted (s), where, what, and how large.

    `kind`: late_start, blocked, slow or fast of wheels, slip or pushed of the body. `size`: measured less predicted
    motion, in rad of a wheel, m or rad of the body. `share`: of the channel's squared mismatches. `source`: the log, of
    several that were searched together, from whose begin the time counts.
    """

    begin_s: float
    duration_s: float
    channel: str
    side: str
    kind: str
    size: float
    unit: str
    share: float
    text: str
    source: str = ""

    def describe(self) -> str:
        """Describe when the event began, in which of several logs, and what happened."""
        of = f" of {self.source}" if self.source else ""
        return f"at {self.begin_s:.1f} s{of} {self.text}"


def rare_events(
    channels: Sequence[ChannelResult], sources: Sequence[str], log_begins_s: Sequence[float]
) -> tuple[RareEvent, ...]:
    """Return the rare events of all channels by log and time; chance makes one in a share `event_chance` of logs.

    `sources` and `log_begins_s`: the logs that were put one after the other, and when each begins.
    """
    found = [event for one in channels for event in _events_of(one, len(channels))]
    found.sort(key=lambda event: event.begin_s)
    if not 1 < len(sources) == len(log_begins_s):
        return tuple(found)
    place = np.searchsorted(log_begins_s, [event.begin_s + 0.5 * event.duration_s for event in found], side="right") - 1
    return tuple(
        replace(event, source=sources[k], begin_s=event.begin_s - log_begins_s[k])
        for event, k in zip(found, place.tolist(), strict=True)
    )


def main_event(events: Sequence[RareEvent], channel: Channel | None) -> str | None:
    """Describe the event that makes up most of a channel's mismatch; None if none does."""
    there = [event for event in events if channel is not None and event.channel == channel.value and event.share > 0.5]
    return there[0].describe() if there else None


def _events_of(found: ChannelResult, channels: int) -> Iterator[RareEvent]:
    """Events of one channel, the clearest first; what begins within the longest window of one belongs to it."""
    long_s, scans = found.channel.settings.report.event_span_s[1], scan(found, channels)
    excess = [one.excess.copy() for one in scans]
    while excess:
        width = max(range(len(scans)), key=lambda k: float(excess[k].max(initial=0.0)))
        if excess[width].max(initial=0.0) <= 1.0:
            return
        place, component = divmod(int(np.argmax(excess[width])), excess[width].shape[1])
        from_s, to_s = float(scans[width].begin_s[place]), float(scans[width].end_s[place])
        # Of an even mismatch in white noise the window fits best whose sum over the root of its length is largest.
        options = []
        for k, one in enumerate(scans):
            about = (one.middle_s >= from_s) & (one.middle_s <= to_s)
            fits = np.where(about, np.abs(one.off[:, component]) / np.sqrt(one.end_s - one.begin_s), 0.0)
            options.append((float(fits.max(initial=0.0)), k, int(np.argmax(fits)) if fits.size else 0))
        _, k, place = max(options)
        event = _told(found, scans[k], place, component)
        yield event
        for one, of in zip(scans, excess, strict=True):
            of[(one.end_s > event.begin_s - long_s) & (one.begin_s < event.begin_s + event.duration_s + long_s)] = 0.0


def _told(found: ChannelResult, windows: Windows, place: int, component: int) -> RareEvent:
    """Describe the event of a window in words."""
    begin_s, end_s = float(windows.begin_s[place]), float(windows.end_s[place])
    off, predicted, share = windows.off[place], windows.predicted[place], windows.share(begin_s, end_s)
    lasted_s, size = end_s - begin_s, float(off[component])
    less = off * predicted < 0.0
    how = "less" if less[component] else "more"
    if found.channel.layout.of_wheels:
        both = bool(np.abs(off).min() > 0.5 * np.abs(off).max() and less[0] == less[1])
        side = "both" if both else _SIDES[component]
        who = "the wheels" if both else f"the {side} wheels"
        text = f"{who} turned {abs(size):.2g} rad {how} than expected within {lasted_s:.1f} s"
        kind, stood = "slow" if less[component] else "fast", _stood(found, begin_s, end_s, component)
        if stood is not None:
            begin_s, lasted_s, from_rest, command = stood
            kind = "late_start" if from_rest else "blocked"
            text = f"{who} stood for {lasted_s:.1f} s under a command of {command:.2g} rad/s"
            if from_rest:
                text = f"{who} started {lasted_s:.1f} s late"
        return RareEvent(begin_s, lasted_s, Channel.COMMAND_TO_WHEEL.value, side, kind, size, "rad", share, text)
    unit, verb = ("rad", "turned") if component == _YAW else ("m", "moved")
    kind = "slip" if less[component] else "pushed"
    text = f"the body {verb} {abs(size):.2g} {unit} {how} than the wheels say, for {lasted_s:.1f} s"
    if component == 1:
        kind, where = "pushed", "left" if size > 0.0 else "right"
        text = f"the body moved {abs(size):.2g} m to the {where}, which the wheels do not say, for {lasted_s:.1f} s"
    text = f"{text}: slip" if kind == "slip" else text
    return RareEvent(begin_s, lasted_s, Channel.WHEEL_TO_BODY.value, "body", kind, size, unit, share, text)


def _stood(found: ChannelResult, begin_s: float, end_s: float, side: int) -> tuple[float, float, bool, float] | None:
    """When and for how long (s) a wheel stood that should have turned, whether it did before, and the command (rad/s).

    None if it did not stand for half of the window.
    """
    channel, drive = found.channel, found.channel.drive
    assert isinstance(channel, WheelChannel)
    rest_rad_s, edge_s = drive.settings.grid.rest_rad_s, drive.settings.grid.speed_span_s
    expected = np.gradient(channel.angles(*found.selector.split(found.names))[:, side], GRID_STEP_S)
    stands = np.abs(drive.speed_rad_s[:, side]) < rest_rad_s
    held = stands & (np.abs(expected) > rest_rad_s)
    inside = held & (drive.t_s >= begin_s) & (drive.t_s < end_s)
    if inside.sum() * GRID_STEP_S < 0.5 * (end_s - begin_s):
        return None
    label = np.cumsum(np.diff(held, prepend=False))
    span = np.flatnonzero(label == np.argmax(np.bincount(label[inside])))
    command = float(np.nanmedian(drive.command_rad_s[span, side]))
    # A speed is a mean over so long either side, and none only where the wheel stands all that time.
    lasted_s = span.size * GRID_STEP_S + 2.0 * edge_s
    return float(drive.t_s[span[0]]) - edge_s, lasted_s, bool(stands[max(span[0] - 1, 0)]), command
