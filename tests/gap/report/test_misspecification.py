"""A slip that saturates is called by its family's name, and said to be of another form; one that does not is not."""

from dataclasses import replace

import numpy as np
import pytest

from disco_hw.gap.data import BODY
from disco_hw.gap.data.free_runs import read_angles
from disco_hw.gap.noise.channels import BodyChannel
from disco_hw.gap.report.misspecification import _perturbation_of, misspecified_effects
from disco_hw.gap.search.channel_search import ChannelResult, body_moves
from disco_hw.gap.search.selection import Selector
from disco_hw.gap.search.unnamed_terms import motion
from tests.gap.synthetic import GEOMETRY, NOISE, line_of

# Turns at four rates: at two of them a wrong axial distance makes up for any form.
DRIVE = ((4, 4), (0, 0), (-1, 1), (1, -1), (-2, 2), (2, -2), (-3.5, 3.5), (3.5, -3.5), (-6, 6), (6, -6), (3, 6), (6, 3))


def slipping(k_s, saturates_at_rad_s=None):
    """What is found in a drive whose turns slip by k |omega|, or k |omega| / (1 + |omega| / saturates_at)."""
    line = line_of(np.repeat(np.array(DRIVE * 3, dtype=float), 200, axis=0))
    plain = BODY.neutral.copy()
    plain[:3] = GEOMETRY
    channel = BodyChannel.build(line, NOISE, plain)
    truth, rate = plain.copy(), motion(line, plain)[1]
    perturbation = np.zeros((rate.size, 3))
    if saturates_at_rad_s is None:
        truth[BODY.place["turn_slip.k_s"]] = k_s
    else:
        perturbation[:, 2] = -k_s * rate * np.abs(rate) / (1.0 + np.abs(rate) / saturates_at_rad_s)
    clean = np.empty((line.pose.t_s.size, 3))
    read_angles(channel.track(truth, perturbation), line.pose.node, line.pose.fraction, clean)
    noise = np.random.default_rng(5).standard_normal(clean.shape) * (0.004, 0.004, 0.006)
    channel = BodyChannel.build(replace(line, pose_values=clean + noise), NOISE, plain)
    selector = Selector(channel, body_moves(channel))
    return ChannelResult(selector, ("turn_slip",), channel)


def test_slip_that_saturates_is_stronger_where_it_is_small():
    (told,) = misspecified_effects(slipping(0.4, 0.5))
    assert "turn_slip" in told
    assert float(told.split(" is ")[1].split(" times")[0]) > 1.2


def test_what_turns_less_is_not_pushed_sideways():
    found = slipping(0.1)
    perturbation = _perturbation_of(found.selector.split(found.names), "turn_slip", found.channel)
    assert np.abs(perturbation[:, 2]).max() > 0.1
    # The tracked point, GEOMETRY[2] behind the one that rolls, moves to the side because the yaw rate is another.
    assert np.abs(perturbation[:, :2]).max() < 1e-9


@pytest.mark.parametrize("k_s", [0.05, 0.1])
def test_slip_that_does_not_is_of_its_form(k_s):
    assert misspecified_effects(slipping(k_s)) == []


def test_what_acts_nowhere_says_nothing():
    found = slipping(0.05)
    assert misspecified_effects(replace(found, names=("pose_latency",))) == []
