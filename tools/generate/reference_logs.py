"""Writes the reference logs that tests/runtime/test_reference_logs.py replays.

    python -m tools.generate.reference_logs [DIRECTORY [NAME ...]]

Only after a change that is meant to alter estimates, plans or commands: the test says at which tick and in which field
a build first differs from the one that recorded them.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import msgspec

from disco_hw.adaptation import AdaptationUpdate, NoAdaptation
from disco_hw.adaptation.guard import NAMES, believed_geometry
from disco_hw.config import SHIPPED_ROBOT
from disco_hw.control.plan import PLANNER_VERSION
from disco_hw.drive import ManualInput
from disco_hw.drive.coverage import Coverage
from disco_hw.drive.hand_pilot import HandPilot
from disco_hw.experiments.simulated_time import SimulatedRun, virtual_robot
from disco_hw.log import MODEL_TOML, ROBOT_TOML, Attachment, version
from disco_hw.log.process_recorder import ProcessRecorder, RecordingSettings
from disco_hw.log.records import BeliefChange, FrameIn, FrameOut
from disco_hw.runtime.assembly import apply_geometry, create_planner
from disco_hw.runtime.pipeline import NoPlanner, Planner
from disco_hw.runtime.robot_setup import Setup, load_setup
from disco_hw.runtime.supervisor import UserRequest
from sim.body_dynamics import BodyPose
from sim.plant_parameters import PlantParameters

DIRECTORY = Path(__file__).parents[2] / "tests" / "runtime" / "reference_logs"
ROBOTS = SHIPPED_ROBOT.parent
HORIZON = ("rate_hz = 50.0", "rate_hz = 50.0\nhorizon = 10")
"""Ten steps instead of fifty: plans are most of a log."""


class SingleAdaptation(NoAdaptation):
    """A belief that changes once, at `at_ns`, to a wheel 2 % larger."""

    def __init__(self, stack: SimulatedRun, at_ns: int) -> None:
        self._stack, self._at_ns, self._model = stack, at_ns, setup().model
        self._done = False

    def step(self, now_ns: int) -> AdaptationUpdate:
        if self._done or now_ns < self._at_ns:
            return AdaptationUpdate()
        self._done = True
        believed = believed_geometry(self._model)
        mean = believed.mean.copy()
        mean[NAMES.index("wheel_radius_m")] *= 1.02
        adapted = replace(believed, mean=mean)
        apply_geometry(self._stack.core.pipeline, self._model, adapted)
        change = BeliefChange(
            now_ns, "adapted", NAMES, tuple(mean.tolist()), tuple(adapted.covariance.ravel().tolist())
        )
        return AdaptationUpdate((change,))


class Hand:
    """Drives a curve to the left, then backwards."""

    ended, completed, task = None, True, ""

    def poll(self, now_ns: int, _robot: object) -> ManualInput:
        wheels = (2.0, 4.0) if now_ns < 3_000_000_000 else (-3.0, -2.0)
        return ManualInput(now_ns, *wheels, now_ns > 1_000_000_000)

    def close(self) -> None:
        pass


def robot_toml(mode: str = "sampled") -> str:
    """The shipped robot, planning in few steps in a mode."""
    text = (ROBOTS / "wombot.toml").read_text(encoding="utf-8")
    assert HORIZON[0] in text
    # Sampled plans of so few steps have to look as far. Refined ones see as far anyway.
    steps = "" if mode == "default" else "\nstep_s = 0.3"
    return text.replace(HORIZON[0], f'{HORIZON[1]}{steps}\nmode = "{mode}"')


def setup(mode: str = "sampled") -> Setup:
    """The robot of these logs, and its model."""
    with tempfile.TemporaryDirectory() as directory:
        robot = Path(directory) / "robot.toml"
        robot.write_text(robot_toml(mode), encoding="utf-8")
        return load_setup(robot, ROBOTS / "wombot_model.toml")


def planner(mode: str = "sampled") -> Planner:
    """Create the planner DISCO for the robot of these logs."""
    found = setup(mode)
    return create_planner(found.config, found.model)


def simulated(chosen: Planner, needs_pose: bool = True) -> SimulatedRun:
    """The shipped robot on its circle."""
    shipped = load_setup(ROBOTS / "wombot.toml")
    robot = virtual_robot(shipped, PlantParameters(), BodyPose(0.75, 0.0, 1.5707963))
    return SimulatedRun(shipped, robot, chosen, needs_pose=needs_pose)


def circle() -> SimulatedRun:
    """DISCO drives, the robot is carried off by 0.2 m, and drives on."""
    stack = _started(simulated(planner()))
    stack.run(1.0)
    stack.robot.board.plant.kidnap(0.2, 0.1, 0.3)
    stack.run(1.5)
    stack.run(0.6, UserRequest.DISARM)
    return stack


def refined() -> SimulatedRun:
    """DISCO drives in its default mode, which refines the plan once the robot is under way."""
    stack = _started(simulated(planner("default")))
    stack.run(1.5)
    return stack


def adapted() -> SimulatedRun:
    """Another belief comes into force on the way, and another circle after it."""
    stack = simulated(planner())
    stack.core.adaptation = SingleAdaptation(stack, 2_500_000_000)
    _started(stack)
    stack.run(1.5)
    stack.run(0.3, UserRequest.STOP)
    stack.core.set_task(msgspec.structs.replace(stack.core.task, radius_m=1.0))
    stack.run(1.0, UserRequest.START)
    return stack


def drive() -> SimulatedRun:
    """Drive by hand and return the run."""
    stack = simulated(NoPlanner(), needs_pose=False)
    stack.pilot = HandPilot(Hand(), Coverage(8.0))
    stack.run(4.5)
    return stack


KINDS: dict[str, Callable[[], SimulatedRun]] = {
    "circle": circle,
    "adapted": adapted,
    "drive": drive,
    "refined": refined,
}


def write(name: str, directory: Path) -> Path:
    """Record the run of that name, without its raw frames, which a replay does not need."""
    stack = KINDS[name]()
    robot = robot_toml("default" if name == "refined" else "sampled")
    files = {ROBOT_TOML: robot.encode(), MODEL_TOML: (ROBOTS / "wombot_model.toml").read_bytes()}
    attachments = tuple(Attachment(attached, "application/toml", content) for attached, content in files.items())
    path = directory / f"{name}.mcap"
    path.unlink(missing_ok=True)
    recorder = ProcessRecorder(
        RecordingSettings(path, "wombot", version(), PLANNER_VERSION, attachments, queue_ticks=100_000)
    )
    for now_ns, recorded in stack.recorder.ticks:
        recorder.put(now_ns, [record for record in recorded if not isinstance(record, FrameIn | FrameOut)])
    stats = recorder.close(30.0)
    if stats.dropped_ticks or stats.refused:
        raise RuntimeError(f"{path}: {stats}")
    return path


def _started(stack: SimulatedRun) -> SimulatedRun:
    stack.run(1.0)
    stack.run(0.5, UserRequest.ARM)
    stack.run(0.5, UserRequest.START)
    return stack


def main() -> int:
    directory = Path(sys.argv[1]) if len(sys.argv) > 1 else DIRECTORY
    directory.mkdir(parents=True, exist_ok=True)
    for name in sys.argv[2:] or KINDS:
        path = write(name, directory)
        print(f"{path}: {path.stat().st_size / 1000:.0f} kB")
    return 0


if __name__ == "__main__":
    sys.exit(main())
