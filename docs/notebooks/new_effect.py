# A new effect: a robot does what its model does not; the log of a drive says what is missing, and the model gets it.
# Cells (# %%) open in VS Code, Spyder and, with jupytext, in Jupyter.

# %% Something hidden in the virtual robot: its wheels do not turn below 0.8 rad/s.
import itertools
from pathlib import Path

import disco_hw
from disco_hw import Model, drive_virtual, find_gap, load_robot, read_log, save_model

ROBOT = Path(disco_hw.__file__).parent / "robots" / "wombot.toml"
WHEELS = [(3, 3), (1, 2), (0.5, 1), (-3, 3), (-1, -1), (3, -3), (6, 3), (0.6, 0.6), (-2, -5), (1, -1), (0, 0), (6, 6)]
speeds = itertools.cycle(pair for pair in WHEELS for _ in range(100))
drive_virtual(ROBOT, lambda *_: next(speeds), seconds=72.0, hide={"deadband": 0.8}, log="new_effect.mcap")

# %% What the nominal model lacks.
report = find_gap(read_log("new_effect.mcap"), Model.nominal(load_robot(ROBOT).robot))
for effect in report.effects:
    print(effect)

# %% The model that has it, for `disco-hw run --model` and for the planner.
save_model(report.model, "new_effect.toml")
print(Path("new_effect.toml").read_text())
