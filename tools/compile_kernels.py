"""`make test` begins with this: compiles, beside the type checker, what each test process would compile for itself."""

from __future__ import annotations

import sys
from pathlib import Path

import disco_hw
from disco_hw.gap.find import missing_effects
from disco_hw.model import Model
from disco_hw.runtime.assembly import make_planner
from disco_hw.runtime.robot_setup import load_setup
from tools.gap_logs import simulated_drive

ROBOT = Path(disco_hw.__file__).parent / "robots" / "wombot.toml"


def main() -> int:
    setup = load_setup(ROBOT)
    make_planner(setup.config, setup.model)
    missing_effects(simulated_drive({}, seed=1, drive="circle"), Model(0.061, 0.415, 0.238))
    return 0


if __name__ == "__main__":
    sys.exit(main())
