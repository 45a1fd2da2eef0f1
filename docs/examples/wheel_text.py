"""Lines of `time left right` (s, rad/s, rad/s) behind the word WHEELS: wheel speeds without commands or poses."""

from pathlib import Path

import numpy as np

from disco_hw.config import RobotConfig
from disco_hw.errors import LogError
from disco_hw.files import DRIVE_CSV, read_lines
from disco_hw.log.drive import Commands, DriveLog, Poses, Wheels, integrate_angle
from disco_hw.log.importing import LogFormat


def read(path: Path, config: RobotConfig) -> DriveLog:
    """Wheel speeds of the file; raises LogError."""
    rows = []
    for number, line in enumerate(read_lines(path, DRIVE_CSV), start=1):
        if number == 1:
            continue
        try:
            t_s, left, right = map(float, line.split())
        except ValueError:
            raise LogError(f"{path}: line {number}: not three numbers; write time, left and right") from None
        rows.append((t_s, left, right))
    t_s, left, right = np.array(rows, dtype=np.float64).reshape(-1, 3).T
    one = np.zeros(t_s.size, dtype=np.int64)
    return DriveLog(
        (str(path),),
        Commands(),
        Wheels(t_s, integrate_angle(t_s, left, one), integrate_angle(t_s, right, one), left, right, one, False, True),
        Poses(),
    )


FORMAT = LogFormat("wheel text", lambda begin: begin.startswith(b"WHEELS"), read)
