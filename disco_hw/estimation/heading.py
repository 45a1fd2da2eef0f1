"""Belief over a pose whose heading is not known: a Gaussian mixture over the circle, which positions and motion narrow.

An extended Kalman filter cannot begin with a heading that is anywhere, as it is linear about one. Each component is
such a filter about a heading of its own (Alspach and Sorenson 1972); those that the positions contradict lose their
weight, until the rest are one.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import msgspec

from disco_hw.estimation.belief import MotionModel, PoseBelief, belief_at
from disco_hw.estimation.correction import Correction, Measurement, PoseCorrector
from disco_hw.estimation.odometry import Pose, wrap

COMPONENTS = 16
# Gaussians at two standard deviations from one another add up to a uniform density within 1.5 %.
_COMPONENT_STD_RAD = math.pi / COMPONENTS
_LEAST_WEIGHT = 1e-5


class HeadingSearch(msgspec.Struct, frozen=True, gc=False):
    """Components and their weights, which add up to 1."""

    beliefs: tuple[PoseBelief, ...]
    weights: tuple[float, ...]

    def each(self, change: Callable[[PoseBelief], PoseBelief]) -> HeadingSearch:
        """The same with each component changed."""
        return HeadingSearch(tuple(change(belief) for belief in self.beliefs), self.weights)

    def merged(self) -> PoseBelief:
        """The Gaussian with the same mean and covariance; the heading's are those on the circle."""
        pairs = list(zip(self.weights, self.beliefs, strict=True))
        x = sum(w * b.x_m for w, b in pairs)
        y = sum(w * b.y_m for w, b in pairs)
        yaw = math.atan2(sum(w * math.sin(b.yaw_rad) for w, b in pairs), sum(w * math.cos(b.yaw_rad) for w, b in pairs))
        # The mean of the sensitivities takes no more from the covariance than the components' own do.
        sensitivity = None
        if all(b.sensitivity is not None for _, b in pairs):
            columns = zip(*(b.sensitivity for _, b in pairs if b.sensitivity is not None), strict=True)
            a, b_, c, d, e, f, g, h, i = (
                sum(w * value for w, value in zip(self.weights, column, strict=True)) for column in columns
            )
            sensitivity = (a, b_, c, d, e, f, g, h, i)
        xx = xy = xt = yy = yt = tt = 0.0
        for w, b in pairs:
            (b_xx, b_xy, b_xt), (_, b_yy, b_yt), (_, _, b_tt) = b.covariance
            dx, dy, dt = b.x_m - x, b.y_m - y, wrap(b.yaw_rad - yaw)
            xx, xy, xt = xx + w * (b_xx + dx * dx), xy + w * (b_xy + dx * dy), xt + w * (b_xt + dx * dt)
            yy, yt, tt = yy + w * (b_yy + dy * dy), yt + w * (b_yt + dy * dt), tt + w * (b_tt + dt * dt)
        if sensitivity is not None:
            x0, x1, x2, y0, y1, y2, t0, t1, t2 = sensitivity
            xx -= x0 * x0 + x1 * x1 + x2 * x2
            xy -= x0 * y0 + x1 * y1 + x2 * y2
            xt -= x0 * t0 + x1 * t1 + x2 * t2
            yy -= y0 * y0 + y1 * y1 + y2 * y2
            yt -= y0 * t0 + y1 * t1 + y2 * t2
            tt -= t0 * t0 + t1 * t1 + t2 * t2
        return PoseBelief(x, y, yaw, xx, xy, xt, yy, yt, tt, sensitivity)


def any_heading(measurement: Measurement, model: MotionModel) -> HeadingSearch:
    """Where the sensor was, with every heading alike; a heading that was measured is not looked at."""
    tt = _COMPONENT_STD_RAD**2
    beliefs = []
    for k in range(COMPONENTS):
        yaw = wrap(math.tau * k / COMPONENTS)
        ahead_x, ahead_y, by_yaw_x, by_yaw_y = measurement.lever(yaw)
        place = Pose(measurement.pose.x_m - ahead_x, measurement.pose.y_m - ahead_y, yaw)
        belief = belief_at(place, measurement.position_variance, tt, model)
        beliefs.append(
            msgspec.structs.replace(
                belief,
                xx=belief.xx + by_yaw_x * by_yaw_x * tt,
                xy=by_yaw_x * by_yaw_y * tt,
                xt=-by_yaw_x * tt,
                yy=belief.yy + by_yaw_y * by_yaw_y * tt,
                yt=-by_yaw_y * tt,
            )
        )
    return HeadingSearch(tuple(beliefs), (1.0 / COMPONENTS,) * COMPONENTS)


def correct_search(
    search: HeadingSearch, measurement: Measurement, corrector: PoseCorrector
) -> tuple[HeadingSearch, Correction]:
    """The search after a measurement, and the correction of the component that fits it best."""
    corrections = [corrector.correct(belief, measurement) for belief in search.beliefs]
    logs = [math.log(w) + c.log_density for w, c in zip(search.weights, corrections, strict=True)]
    most = max(logs)
    kept = [(math.exp(log - most), c) for log, c in zip(logs, corrections, strict=True)]
    kept = [(weight, c) for weight, c in kept if weight > _LEAST_WEIGHT]
    total = sum(weight for weight, _ in kept)
    after = HeadingSearch(tuple(c.belief for _, c in kept), tuple(weight / total for weight, _ in kept))
    return after, min(corrections, key=lambda correction: correction.distance2)
