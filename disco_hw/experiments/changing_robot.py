"""A robot whose wheels or axle grow on the way, driven by the real daemon in real time, adapting or not."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import disco_hw
from disco_hw.adaptation.guard import Geometry, believed_geometry, with_geometry
from disco_hw.adaptation.link import NAMES
from disco_hw.experiments.adapt import BELIEVED_STD, CHANGES
from disco_hw.experiments.live_stack import running_stack
from disco_hw.log.reader import open_log
from disco_hw.model.file import load_model, model_text

GROWTH = 0.15
CHANGE_S = 75.0
SETTLED_S = 20.0
COMPARED_S = 20.0
TASK = 'kind = "circle"\nradius_m = 0.75\nspeed_m_s = 0.2\n'
START = (0.75, 0.0, 1.5707963)


@dataclass(frozen=True, slots=True)
class LiveDrive:
    """Mean tracking costs on the plant's truth, over 20 s before the change and from 20 s after it on; what changed, by
    its size before, as the robot believed it at last, how long after the change (s) it was first told, and what the
    loop missed.
    """

    cost_before: float
    cost_after: float
    believed: float
    published_s: float
    overruns: int


def drive_through_change(directory: Path, changes: str, *, adapt: bool) -> LiveDrive:
    """The paper's circle; the belief is right, and as narrow as after `infer`, until the wheel radius or axial distance
    (`changes`) grows by 15 %.
    """
    model = load_model(Path(disco_hw.__file__).parent / "robots" / "wombot_model.toml")
    mean = believed_geometry(model).mean
    std = BELIEVED_STD * np.array([1.0, mean[1], mean[2]])
    narrow = directory / "narrow.toml"
    narrow.write_text(model_text(with_geometry(model, Geometry(mean, np.diag(std**2)))), encoding="utf-8")
    axle, wheels = CHANGES[changes]
    hidden = ("--hide", f"surface_change={axle * GROWTH},{CHANGE_S},{wheels * GROWTH}")
    arguments = ("--adapt",) if adapt else ()
    with running_stack(directory, "can", TASK, START, hidden, arguments, str(narrow)) as stack:
        stack.operator.wait_for("READY", 60.0)
        stack.start()
        stack.operator.wait_until("driving", lambda s: s["source"] == "plan", 10.0)
        first_s = first_truth_s(directory / "truth.csv")
        end_s = first_s + CHANGE_S + SETTLED_S + COMPARED_S
        status = stack.operator.wait_until("the end", lambda s: newest_truth_s(directory / "truth.csv") > end_s, 200.0)
        stack.operator.tell("quit")
        assert stack.daemon.process.wait(10.0) == 0
    table = np.genfromtxt(directory / "truth.csv", delimiter=",", skip_header=1, usecols=(0, 1, 2, 8))
    t_s = table[:, 0] * 1e-9 - first_s - CHANGE_S
    cost = np.hypot(np.hypot(table[:, 1], table[:, 2]) - 0.75, table[:, 3] - 0.2)
    with open_log(directory / "run.mcap") as log:
        times_ns = log.columns("/belief")["t_ns"].tolist() if adapt else []
        published = [t_ns * 1e-9 - first_s - CHANGE_S for t_ns in times_ns]
        published_s = min((at for at in published if at > 0.0), default=math.inf)
    index = NAMES.index("wheel_radius_m" if wheels else "axial_distance_m")
    believed = status["adaptation"]["mean"][NAMES[index]] / float(mean[index]) if adapt else 1.0
    return LiveDrive(
        float(cost[(t_s > -COMPARED_S) & (t_s < 0.0)].mean()),
        float(cost[(t_s > SETTLED_S) & (t_s < SETTLED_S + COMPARED_S)].mean()),
        believed,
        published_s,
        int(status["loop"]["overruns"]),
    )


def first_truth_s(path: Path) -> float:
    """When the truth begins, s of the monotonic clock."""
    with path.open(encoding="utf-8") as file:
        file.readline()
        return int(file.readline().partition(",")[0]) * 1e-9


def newest_truth_s(path: Path) -> float:
    """When the newest row on disk was true."""
    with path.open("rb") as file:
        file.seek(0, 2)
        file.seek(max(0, file.tell() - 1000))
        rows = [row for row in file.read().split(b"\n")[1:-1] if row.count(b",") > 10]
    return int(rows[-1].partition(b",")[0]) * 1e-9
