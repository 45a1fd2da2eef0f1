import numpy as np

from disco_hw.inference.checks import driven, undetermined
from disco_hw.inference.excitation import excitation
from tests.inference.drives import logged

LOW, HIGH = np.array([0.0, 0.0, 0.1]), np.array([0.5, 0.5, 0.5])
SHARP = np.array([0.12, 0.06, 0.45])


def sentences(draws, drive, paper=False):
    return undetermined(draws, LOW, HIGH, excitation(logged(drive)), paper)


def gaussian(mean, sd):
    return np.random.default_rng(0).normal(mean, sd, (2000, 3))


def test_a_sharp_posterior_of_a_rich_drive_leaves_nothing_open():
    assert sentences(gaussian(SHARP, 0.001), "rich") == []


def test_a_steady_circle_is_warned_of_whatever_the_posterior():
    (only,) = sentences(gaussian(SHARP, 0.001), "circle")
    assert "steady circle cannot tell the wheel radius" in only
    assert "straight line" in only


def test_a_wide_parameter_is_named_with_what_to_drive():
    (only,) = sentences(gaussian(SHARP, [0.001, 0.001, 0.08]), "straight")
    assert only.startswith("the axial distance is left open")
    assert "turn left and right on the spot" in only


def test_two_parameters_that_trade_off_are_named_together():
    along = np.random.default_rng(0).normal(0.0, 0.1, 2000)
    draws = gaussian(SHARP, 0.001)
    draws[:, 0] += along
    draws[:, 2] -= along
    (only,) = sentences(draws, "rich")
    assert only.startswith("x_icr and the axial distance together")
    assert "one can grow while the other shrinks" in only


def test_the_papers_statistics_are_said_to_miss_the_wheel_radius():
    found = sentences(gaussian(SHARP, [0.001, 0.12, 0.001]), "circle", paper=True)
    assert found[0].startswith("the wheel radius is left open")
    assert any("so it stays about as wide as the prior" in sentence for sentence in found)


def test_stock_is_taken_of_what_was_driven():
    circle, straight, rich = (driven(excitation(logged(name))) for name in ("circle", "straight", "rich"))
    assert circle.steady
    assert not rich.steady
    assert not straight.steady
    assert straight.straight_rad > 50.0
    assert straight.left_rad < 6.0
    assert min(rich.left_rad, rich.right_rad, rich.reverse_rad) > 6.0
