# Control: a law of your own beside DISCO, on the same virtual robot. Cells (# %%) open in VS Code, Spyder and Jupyter.

# %% A law of your own: turn towards the circle, the faster the farther beside it.
import math
from pathlib import Path

import numpy as np

import disco_hw
from disco_hw import drive_virtual

ROBOT = Path(disco_hw.__file__).parent / "robots" / "wombot.toml"
RADIUS_M, SPEED_M_S, WHEEL_M, AXLE_M = 0.75, 0.2, 0.06, 0.31


def law(state, task, model):
    """Wheel speeds, left and right (rad/s), for the pose in `state`."""
    x_m, y_m, yaw_rad = state.x_m, state.y_m, state.yaw_rad
    outside_m = math.hypot(x_m, y_m) - RADIUS_M
    wanted_rad = math.atan2(y_m, x_m) + 0.5 * math.pi + math.atan(2.0 * outside_m)
    yaw_rate = SPEED_M_S / RADIUS_M + 1.5 * math.remainder(wanted_rad - yaw_rad, math.tau)
    half = 0.5 * yaw_rate * AXLE_M
    return (SPEED_M_S - half) / WHEEL_M, (SPEED_M_S + half) / WHEEL_M


# %% Both on the circle of the paper, 20 s of simulated time.
for name, chosen in (("mine", law), ("DISCO", None)):
    drive = drive_virtual(ROBOT, chosen, seconds=20.0)
    off_m = np.hypot(drive.poses[:, 0], drive.poses[:, 1]) - RADIUS_M
    print(f"{name}: RMS distance {np.sqrt(np.mean(off_m**2)):.4f} m")
