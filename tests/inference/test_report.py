import numpy as np

from disco_hw.inference.checks import CHECKS
from disco_hw.inference.report import calibration_figure, pairs_figure, predictive_figure


def test_the_bars_beyond_the_limit_are_marked():
    deviations = np.zeros(len(CHECKS))
    deviations[3] = 9.0
    (axis,) = predictive_figure(deviations).axes
    colours = [bar.get_facecolor() for bar in axis.patches[: len(CHECKS)]]
    assert colours[3] != colours[0]
    assert len(set(colours)) == 2


def test_every_pair_of_parameters_has_its_picture():
    draws = np.random.default_rng(0).standard_normal((500, 3))
    axes = pairs_figure(draws).axes
    assert sum(axis.axison for axis in axes) == 6


def test_every_parameter_has_its_ranks():
    axes = calibration_figure(np.random.default_rng(0).random((300, 3))).axes
    assert len(axes) == 3
    assert sum(bar.get_height() for bar in axes[0].patches[-15:]) == 300
