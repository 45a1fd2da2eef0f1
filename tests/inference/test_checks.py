import numpy as np
import pytest

from disco_hw.effects import Symptom
from disco_hw.inference.checks import CHECKS, Scores
from disco_hw.inference.estimates import estimates
from disco_hw.inference.excitation import excitation
from disco_hw.inference.infer import noise_of
from tests.inference.drives import logged
from tests.tables import thinned


def scores(hidden=(), drive="rich", seed=5):
    excited_drive = excitation(logged(drive, seed, hidden))
    values = Scores(excited_drive, estimates(excited_drive, noise_of(excited_drive)))(excited_drive.pose)
    return dict(zip((check.name for check in CHECKS), values, strict=True))


def test_every_symptom_is_tested_for_and_some_effect_shows_it():
    assert {check.symptom for check in CHECKS} == set(Symptom)
    assert all(check.effects for check in CHECKS)


def test_nothing_hidden_leaves_no_pattern_and_a_drive_that_cannot_show_one_no_false_alarm():
    assert np.abs(list(scores().values())).max() < 4.5
    assert np.isfinite(list(scores(drive="circle", seed=1).values())).all()


@thinned(
    ("effect", "value", "name"),
    [
        ("turn_slip", 0.08, "less turn at speed"),
        ("side_slip", 0.12, "sideways in fast turns"),
        ("pose_latency", 0.08, "late positions"),
        ("wheel_radius_asymmetry", 0.015, "turns on straights"),
        ("lateral_icr", 0.03, "forward with turning"),
    ],
    quick=1,
)
def test_a_hidden_effect_stands_out_in_its_check(effect, value, name):
    found = scores(((effect, value),))
    assert abs(found[name]) > 6.0
    assert abs(found[name]) == max(abs(score) for score in found.values())


@pytest.mark.thorough
@thinned(("track", "radius", "name"), [(0.1, 0.0, "turning changes"), (0.0, 0.04, "distance changes")], quick=1)
def test_a_change_during_the_drive_stands_out_and_says_which_way_it_went(track, radius, name):
    for sign in (1.0, -1.0):
        middle_s = 0.5 * float(logged("rich", 5).wheels.t_s[-1])
        found = scores((("surface_change", (sign * track, middle_s, sign * radius)),))
        assert abs(found[name]) > 6.0
        assert abs(found[name]) == max(abs(score) for score in found.values())
        # A wider track turns less for the same wheels from then on; a larger radius goes further.
        assert np.sign(found[name]) == (sign if name == "distance changes" else -sign)
