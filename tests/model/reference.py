"""The run of a model by the reference's steps, which the compiled step is compared with."""

import numpy as np

from disco_hw.model import plain


def reference_run(model, in_force, step_s, time_s=0.0):
    """Return x, y, yaw and both wheel speeds (M, 5) at the start and after each step under the commands in force."""
    theta = plain.theta_of(model.parameter_names, model.point())
    states = [plain.RobotState(0.0, 0.0, 0.0, 0.0, 0.0)]
    for t, (left, right) in enumerate(in_force):
        states.append(plain.step(theta, states[-1], left, right, step_s, time_s + t * step_s)[0])
    return np.array([[s.x, s.y, s.yaw, s.wheel_left, s.wheel_right] for s in states])
