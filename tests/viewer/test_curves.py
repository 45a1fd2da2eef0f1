import numpy as np
import pytest

from disco_hw.model import Gaussian, Mixture, Model, Uniform
from disco_hw.tasks.circle import CircleTask
from disco_hw.viewer import curves
from tools.viewer_run import LEFT_RAD_S, PERIOD_NS, RIGHT_RAD_S, SPEED_M_S, START_NS

END_NS = START_NS + 199 * PERIOD_NS
NAMES = ("wheel_radius_m", "axial_distance_m", "x_icr_m")


def test_distance_is_positive_outside(timeline):
    on = curves.distance(CircleTask(radius_m=0.75), timeline, START_NS, END_NS)
    outside = curves.distance(CircleTask(radius_m=0.5), timeline, START_NS, END_NS)
    assert on.values["distance (m)"] == pytest.approx(0.0, abs=1e-9)
    assert outside.values["distance (m)"] == pytest.approx(0.25)
    assert on.t_s[[0, -1]] == pytest.approx((0.0, 3.98))


def test_speed_and_wheels(timeline):
    speed = curves.speed(CircleTask(speed_m_s=0.3), timeline, START_NS, END_NS).values
    assert np.all(speed["speed (m/s)"] == SPEED_M_S)
    assert np.all(speed["reference"] == 0.3)
    wheels = curves.wheels(timeline, END_NS - 1_000_000_000, END_NS)
    assert len(wheels.t_s) == 51
    assert np.all(wheels.values["left asked"] == LEFT_RAD_S)
    assert np.all(wheels.values["right measured"] == RIGHT_RAD_S)


def test_planner_and_innovation_with_bounds(timeline):
    planner = curves.planner(timeline, START_NS, END_NS).values
    assert planner["effective samples"].min() == 40.0
    innovation = curves.innovation("y_m", timeline, START_NS, END_NS).values
    assert np.all(innovation["y_m"] == -0.01)
    assert innovation["+99 %"] == pytest.approx(0.0257583, abs=1e-6)
    assert np.all(innovation["-99 %"] == -innovation["+99 %"])


def test_a_long_window_is_thinned(timeline, monkeypatch):
    monkeypatch.setattr(curves, "POINTS", 50)
    assert len(curves._window(timeline, timeline.estimate, START_NS, END_NS, 50)[0]) == 50


@pytest.mark.parametrize(
    "belief",
    [
        Gaussian(NAMES, np.array((0.06, 0.3, 0.1)), np.diag((1e-4, 1e-3, 1e-3))),
        Mixture(
            np.array((0.3, 0.7)),
            (
                Gaussian(NAMES, np.array((0.05, 0.3, 0.1)), np.diag((1e-5, 1e-3, 1e-3))),
                Gaussian(NAMES, np.array((0.07, 0.3, 0.1)), np.diag((1e-5, 1e-3, 1e-3))),
            ),
        ),
        Uniform(NAMES, np.array((0.02, 0.2, 0.0)), np.array((0.1, 0.4, 0.2))),
    ],
)
def test_a_marginal_is_a_density_with_the_beliefs_mean(belief):
    model = Model(0.06, 0.3, belief=belief)
    curve = curves.marginals(model, model, "wheel_radius_m", 4000)
    density, x = curve.values["in force"], curve.t_s
    assert (density == curve.values["model file"]).all()
    step = x[1] - x[0]
    assert density.sum() * step == pytest.approx(1.0, abs=0.01)
    assert (x * density).sum() * step == pytest.approx(belief.mean()[0], rel=0.01)


def test_what_is_known_exactly_has_no_marginal():
    assert curves.marginals(Model(0.06, 0.3), Model(0.06, 0.3), "wheel_radius_m") is None


def test_an_adapted_belief_is_drawn_beside_the_model_files():
    file, adapted = (
        Model(0.06, 0.3, belief=Gaussian(("wheel_radius_m",), np.array((mean,)), np.array(((1e-6,),))))
        for mean in (0.06, 0.07)
    )
    curve = curves.marginals(file, adapted, "wheel_radius_m", 4000)
    peaks = {name: curve.t_s[np.argmax(density)] for name, density in curve.values.items()}
    assert peaks["model file"] == pytest.approx(0.06, abs=1e-4)
    assert peaks["in force"] == pytest.approx(0.07, abs=1e-4)
