"""What the daemon and the adapter's process say to each other: one msgpack message a packet, each small."""

from __future__ import annotations

import msgspec

Triple = tuple[float, float, float]
Nine = tuple[float, float, float, float, float, float, float, float, float]


class Wheels(msgspec.Struct, frozen=True, array_like=True, gc=False):
    """Cumulative wheel angles (rad) at a time."""

    t_ns: int
    left_rad: float
    right_rad: float


class Pose(msgspec.Struct, frozen=True, array_like=True, gc=False):
    """A measured pose (m, rad) at the time when it was true."""

    t_ns: int
    x_m: float
    y_m: float
    yaw_rad: float


class Samples(msgspec.Struct, frozen=True, tag="samples", gc=False):
    """What came in with the tick at `now_ns`."""

    now_ns: int
    wheels: tuple[Wheels, ...] = ()
    poses: tuple[Pose, ...] = ()


class Range(msgspec.Struct, frozen=True, tag="range", gc=False):
    """What the network is to be trained for: geometry between `low` and `high` about `mean`, wheels up to a speed."""

    mean: Triple
    low: Triple
    high: Triple
    wheel_rad_s: float


class InForce(msgspec.Struct, frozen=True, tag="in_force", gc=False):
    """The belief over the geometry (order of `coordinates.NAMES`) that the robot drives by from `now_ns` on.

    `adapted` is False for that of the model file; with `relearn`, what was learnt so far is to be forgotten.
    """

    now_ns: int
    mean: Triple
    covariance: Nine
    adapted: bool
    relearn: bool = False


class Proposal(msgspec.Struct, frozen=True, gc=False):
    """A belief over the geometry from driving up to `t_ns`; `data_s` of it. `doubt` says why it should not be used."""

    t_ns: int
    estimator: str
    mean: Triple
    covariance: Nine
    data_s: float
    doubt: str = ""


class Report(msgspec.Struct, frozen=True, tag="report", gc=False):
    """How learning goes, about once a second.

    `text` is one sentence. `advantage` is the log odds of the recent driving under the belief in force against that of
    the model file, 0 while that file's is in force.
    """

    now_ns: int
    text: str
    proposals: tuple[Proposal, ...] = ()
    advantage: float = 0.0


ToAdapter = Samples | InForce | Range
FromAdapter = Report
