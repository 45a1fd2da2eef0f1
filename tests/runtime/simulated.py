"""The shipped robot in simulated time, as most tests of the tick want it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

from msgspec import structs

from disco_hw.config import SHIPPED_ROBOT
from disco_hw.control.plan import PLANNER_VERSION
from disco_hw.experiments.simulated_time import SimulatedRun, virtual_robot
from disco_hw.log import Attachment, End, Start, batch_encoder
from disco_hw.log.mcap_log import McapLog
from disco_hw.log.records import Record
from disco_hw.runtime.assembly import create_planner
from disco_hw.runtime.core import CoreTick
from disco_hw.runtime.pipeline import Planner
from disco_hw.runtime.replay import ReplayReport, replay
from disco_hw.runtime.robot_setup import kept_files, load_setup
from disco_hw.runtime.supervisor import Reply, UserRequest
from sim.body_dynamics import BodyPose
from sim.plant_parameters import PlantParameters

ROBOT_FILE = SHIPPED_ROBOT
ROBOT_TEXT = SHIPPED_ROBOT.read_text(encoding="utf-8").replace(
    '"wombot_model.toml"', f'"{SHIPPED_ROBOT.with_name("wombot_model.toml")}"'
)
"""The shipped robot.toml, which finds its model from any folder."""
START = BodyPose(0.75, 0.0, 1.5707963)


def simulated_stack(
    planner: Planner | None = None,
    seed: int = 1,
    needs_pose: bool = True,
    robot_file: Path = ROBOT_FILE,
    start: BodyPose = START,
    hide: dict[str, float] | None = None,
    **changes: float,
) -> SimulatedRun:
    """The shipped robot with a plant at the posterior's mean; `hide`: effects, `changes`: fields of PlantParameters."""
    setup = load_setup(robot_file)
    robot = virtual_robot(setup, replace(PlantParameters(), **changes), start, effects=hide, seed=seed)
    return SimulatedRun(setup, robot, planner or create_planner(setup.config, setup.model), needs_pose=needs_pose)


def arm(stack: SimulatedRun) -> None:
    """Wait until the robot is ready, and arm it."""
    stack.run(0.5)
    stack.run(0.3, UserRequest.ARM)


def start(stack: SimulatedRun, seconds: float) -> list[CoreTick]:
    """Arm the robot, start the task, and return the ticks of so long a drive."""
    arm(stack)
    return stack.run(seconds, UserRequest.START)


def recorded(stack: SimulatedRun, kind: type[Record]) -> list[Record]:
    """Return the records of a type that a run has recorded."""
    return [record for _, tick in stack.recorder.ticks for record in tick if isinstance(record, kind)]


def replies(ticks: Iterable[CoreTick]) -> list[Reply]:
    """Return the replies that were given in these ticks."""
    return [reply for tick in ticks for reply in tick.output.replies]


def robot_toml(directory: Path, lines: str) -> Path:
    """Write robot.toml: the shipped one, to which these lines are added; returns its path."""
    path = directory / "robot.toml"
    path.write_text(f"{ROBOT_TEXT}\n{lines}", encoding="utf-8")
    return path


def write_ticks(
    path: Path,
    ticks: Iterable[tuple[int, Sequence[Record]]],
    files: Iterable[Attachment] = (),
    planner: int = PLANNER_VERSION,
    part: int = 1,
    continues_sequence: int | None = None,
    states: Sequence[Record] = (),
    wall_offset_ns: int = 10**18,
    *,
    continued: bool = False,
) -> Path:
    """Write what a recorder was given as a log, in this process: starting another takes longer than a short log."""
    encode, number, now_ns = batch_encoder(), 0, 0
    with path.open("xb") as file:
        begin = Start(str(path), "wombot", "", 0, wall_offset_ns, part, "run.mcap" * (part > 1), continues_sequence)
        log = McapLog(file, structs.replace(begin, attachments=tuple(files), planner=planner))
        log.begin_with(encode(0, 0, states))
        for number, (now_ns, records) in enumerate(ticks, start=1 + (continues_sequence or 0)):
            log.write(encode(number, now_ns, records))
        log.end(End(now_ns, number, 0, continued))
        log.finish()
    assert log.refused == 0
    return path


def write_run(stack: SimulatedRun, path: Path) -> Path:
    """Write the log of a run, with the files of its robot."""
    return write_ticks(path, stack.recorder.ticks, kept_files(stack._setup))


def replayed(log: Path, *arguments: float) -> ReplayReport:
    """Return the report of a replay that must have found no difference."""
    report = replay(log, *arguments)
    assert report.ok, report.as_text()
    return report
