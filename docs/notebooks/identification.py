# Identification: what a drive says of a robot. Cells (# %%) open in VS Code, Spyder and, with jupytext, in Jupyter.
# Needs nothing but disco-hw; run in a directory that may be written to.

# %% A drive that shows the geometry: straight, turns and spins, forward and back, two seconds each.
import itertools
from pathlib import Path

import disco_hw
from disco_hw import drive_virtual, infer, load_robot, read_log

ROBOT = Path(disco_hw.__file__).parent / "robots" / "wombot.toml"
WHEELS = [(3, 3), (2, 5), (5, 2), (-3, 3), (-3, -3), (3, -3), (6, 3), (3, 6), (-2, -5), (-5, -2), (0, 0), (6, 6)]
TICKS_EACH = 100


class Excite:
    """A control law that does not look: wheel speeds, left and right (rad/s), one pair after the other."""

    def __init__(self):
        self.speeds = itertools.cycle(pair for pair in WHEELS for _ in range(TICKS_EACH))

    def __call__(self, state, task, model):
        return next(self.speeds)


drive_virtual(ROBOT, Excite(), seconds=60.0, log="identification.mcap")

# %% What was recorded: arrays of commands, wheels and poses; with pandas, drive.to_pandas().
drive = read_log("identification.mcap")
print(f"{len(drive.poses.t_s)} poses, {len(drive.wheels.t_s)} wheel samples")

# %% The posterior over the geometry, as `disco-hw infer` learns it.
robot = load_robot(ROBOT)
found = infer(drive, robot)
for name, mean, std in zip(found.belief.names, found.draws.mean(axis=0), found.draws.std(axis=0), strict=True):
    print(f"{name}: {mean:.4f} +- {std:.4f}")
