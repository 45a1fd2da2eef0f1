"""The guided first drive against virtual robots with something wrong: found, named, mended, never far from its way."""

from __future__ import annotations

import math
import random
from dataclasses import replace
from itertools import product

import msgspec
import pytest

from disco_hw.errors import InputError, WorkError
from disco_hw.first_use import procedure
from disco_hw.first_use.commission import STAGES, CommissionOptions, as_sent, run_commission, write_fields
from disco_hw.first_use.procedure import (
    MOST_SHARE,
    CommissionPilot,
    FloorSeen,
    Procedure,
    Prompt,
    Reset,
    Silence,
    Track,
)
from disco_hw.log.records import Event
from disco_hw.runtime.assembly import pose_source_of
from disco_hw.runtime.robot_setup import load_setup
from disco_hw.runtime.supervisor import UserRequest
from drivers.types import PoseSample, WheelSample
from sim.devices import odrive
from sim.plant_parameters import PlantParameters
from tests.first_use.miswired import Miswiring, robot_file, stage
from tests.tables import thinned

DRIVERS = ("reference", "odrive", "vesc", "agilex", "roboclaw")
FARTHEST_M = 0.3
# Quick tests: a controller's turn, which boards have five times as short, and fewer poses.
COARSE = {"step_us": 5000, "plant": PlantParameters(pose_rate_hz=10.0)}


@pytest.fixture
def path(tmp_path):
    """A robot.toml of the reference controller."""
    return robot_file(tmp_path)


@pytest.fixture(scope="module")
def shipped(tmp_path_factory):
    """The robot whose drive on the floor is made up."""
    return load_setup(robot_file(tmp_path_factory.mktemp("shipped")))


def coarse_file(directory, driver=None):
    """The robot.toml of quick tests: fewer turns a second, and wheels that take less time for the same way."""
    path = robot_file(directory, driver)
    text = path.read_text("utf-8").replace("rate_hz = 50.0", "rate_hz = 20.0")
    path.write_text(text.replace("max_wheel_speed_rad_s = 8.0", "max_wheel_speed_rad_s = 11.0"), "utf-8")
    return path


def in_millimetres(x, y, yaw):
    return 1e3 * x, 1e3 * y, yaw


def in_degrees(x, y, yaw):
    return x, y, math.degrees(yaw)


def clockwise(x, y, yaw):
    return x, y, -yaw


def mirrored(x, y, yaw):
    return x, -y, yaw


def north_and_east(x, y, yaw):
    return x, -y, -yaw


def turned_aside(x, y, yaw):
    return x, y, yaw + math.pi / 2


def wrong_in_every_way(x, y, yaw):
    return 1e3 * x, -1e3 * y, math.degrees(-yaw) + 90.0


WRONG = {
    "sides swapped": Miswiring(swapped=True),
    "left motor reversed": Miswiring(motors=(-1, 1), encoders=(-1, 1)),
    "right motor reversed": Miswiring(motors=(1, -1), encoders=(1, -1)),
    "left encoder reversed": Miswiring(encoders=(-1, 1)),
    "right encoder reversed": Miswiring(encoders=(1, -1)),
    "encoders swapped": Miswiring(crossed=True),
    "wrong ticks": Miswiring(ratio=2.0),
    "wrong ticks the other way": Miswiring(ratio=0.5),
    "pose in other units": Miswiring(pose=in_millimetres),
    "yaw in other units": Miswiring(pose=in_degrees),
    "yaw the other way round": Miswiring(pose=clockwise),
    "sensor looks aside": Miswiring(pose=turned_aside),
    "axes mirrored": Miswiring(pose=mirrored),
}
FAST = (
    ("sides", "reference", "sides swapped"),
    ("turns", "agilex", "wrong ticks"),
)


def evaluated(path, name, wrong, **options):
    """Drive one stage and judge it; the judgement, the run."""
    one = next(stage for stage in STAGES if stage.name == name)
    seen, run, _operator = stage(path, one.steps, wrong, raw_poses=one.raw_poses, **options)
    return one.evaluate(seen, load_setup(path)), run


def commissioned(path, wrong, names=("sides", "turns", "floor"), **options):
    """Every stage until it finds nothing, robot.toml mended on the way; the names of what was found."""
    found = []
    for name in names:
        for _ in range(2):
            evaluation, run = evaluated(path, name, wrong, **options)
            check_near(run, name)
            found += [fault.name for fault in evaluation.faults]
            if not evaluation.faults:
                break
            if not write_fields(CommissionOptions(path, write=True), evaluation.edits):
                return found
        assert not evaluation.faults, f"not mended: {evaluation.faults}"
    return found


def check_near(run, name):
    """On the floor the robot is where its commands lead; off it no wheel is asked for more than three tenths."""
    plant, lags = run.robot.plant.parameters, run.robot.plant.effects.items
    top = run.core.config.robot.max_wheel_speed_rad_s
    assert all(max(abs(c.left_rad_s), abs(c.right_rad_s)) <= MOST_SHARE * top for c, _ in run.where if c is not None)
    if name != "floor" or lags:
        return
    assert run.slow_rad_s <= MOST_SHARE * top
    first, period_s = run.where[0][1], 1.0 / run.core.config.control.rate_hz
    x, y, yaw, farthest = first.x_m, first.y_m, first.yaw_rad, 0.0
    for command, true in run.where:
        left, right = (0.0, 0.0) if command is None else (command.left_rad_s, command.right_rad_s)
        assert max(abs(left), abs(right)) <= 1.01 * run.slow_rad_s
        v = 0.5 * plant.wheel_radius_m * (left + right)
        w = plant.wheel_radius_m * (right - left) / plant.axial_distance_m
        slip = w * plant.x_icr_m
        x += period_s * (v * math.cos(yaw) + slip * math.sin(yaw))
        y += period_s * (v * math.sin(yaw) - slip * math.cos(yaw))
        yaw += period_s * w
        farthest = max(farthest, math.hypot(true.x_m - x, true.y_m - y))
    assert farthest < FARTHEST_M


@pytest.mark.parametrize(("name", "driver", "wrong"), FAST)
def test_a_fault_is_found_named_and_mended(tmp_path, name, driver, wrong):
    assert commissioned(coarse_file(tmp_path, driver), WRONG[wrong], (name,), **COARSE) == [wrong]


def test_a_pose_wrong_in_every_way_is_mended_at_once(tmp_path):
    path = coarse_file(tmp_path)
    evaluation, run = evaluated(path, "floor", Miswiring(pose=wrong_in_every_way), **COARSE)
    check_near(run, "floor")
    assert write_fields(CommissionOptions(path, write=True), evaluation.edits)
    assert {fault.name for fault in evaluation.faults} == {
        "pose in other units",
        "yaw in other units",
        "yaw the other way round",
        "axes mirrored",
        "sensor looks aside",
    }
    assert load_setup(path).config.pose.yaw_offset_rad == pytest.approx(math.pi / 2, abs=1e-3)
    assert path.with_name("robot.toml.before").exists()


def goes_away(_prompt):
    raise EOFError


STEP_NS = 50_000_000
X_ICR_M, OFFSET, LATENCY_S = 0.12, (0.6, 0.2), 0.1
PER_METRE, PER_RADIAN = {"m": 1.0, "cm": 100.0, "mm": 1000.0}, {"rad": 1.0, "deg": 180.0 / math.pi}
VALUES = {"position_unit": PER_METRE, "yaw_unit": PER_RADIAN, "clockwise": (False, True), "mirrored": (False, True)}
UNITS = [dict(zip(VALUES, units, strict=True)) for units in product(*VALUES.values())]
# Each two values of two fields meet in one of these.
FEW_UNITS = [UNITS[number] for number in (0, 7, 10, 13, 17, 22)]
FEW_AND_ALL = pytest.mark.parametrize(
    "all_units", [pytest.param(FEW_UNITS, id="few"), pytest.param(UNITS, id="all", marks=pytest.mark.thorough)]
)
PLACE = {"origin": (3.0, -2.0, 0.6), "offset": OFFSET, "latency_s": LATENCY_S}


def with_pose(setup, **fields):
    """The robot with these fields in [pose]."""
    pose = msgspec.structs.replace(setup.config.pose, source="robot", **fields)
    return replace(setup, config=msgspec.structs.replace(setup.config, pose=pose))


def sent(pose, x, y, yaw, t_ns):
    """What the sensor of a right [pose] sends while the tracked point is there."""
    (ahead, left), (at_x, at_y, turn) = pose.offset, pose.origin
    x, y = (
        x + ahead * math.cos(yaw) - left * math.sin(yaw) - at_x,
        y + ahead * math.sin(yaw) + left * math.cos(yaw) - at_y,
    )
    x, y = math.cos(turn) * x + math.sin(turn) * y, math.cos(turn) * y - math.sin(turn) * x
    angle = math.remainder((yaw - turn - pose.yaw_offset_rad) * (-1.0 if pose.clockwise else 1.0), 2.0 * math.pi)
    metres, t_ns = PER_METRE[pose.position_unit], t_ns + round(1e9 * pose.latency_s)
    y = -y if pose.mirrored else y
    return PoseSample(t_ns, t_ns, metres * x, metres * y, PER_RADIAN[pose.yaw_unit] * angle, metres * 0.01, 0.01)


def floor_drive(true, written):
    """The drive on the floor by a robot that goes a little to the left; `written`: what robot.toml says of `true`."""
    robot, source = true.config.robot, pose_source_of(as_sent(written).config)
    x, y, yaw, left, right, t_ns = 0.5, 0.3, 0.4, 0.0, 0.0, 0

    def leg(way_m, turn_rad):
        nonlocal x, y, yaw, left, right, t_ns
        track, moving = Track(), 12
        for step in range(3 * moving):
            share = 1.0 / moving if moving <= step < 2 * moving else 0.0
            way, turn = share * way_m, share * turn_rad
            x, y = x + way * math.cos(yaw + 0.5 * turn), y + way * math.sin(yaw + 0.5 * turn)
            apart = 0.5 * turn * robot.axial_distance_m
            left, right = left + (way - apart) / robot.wheel_radius_m, right + (way + apart) / robot.wheel_radius_m
            yaw, t_ns = yaw + turn, t_ns + STEP_NS
            track.wheels.append(WheelSample(t_ns, t_ns, left, right, 0.0, 0.0))
            tracked = x - X_ICR_M * math.cos(yaw), y - X_ICR_M * math.sin(yaw), yaw
            track.poses += source.receive(t_ns, [sent(true.config.pose, *tracked, t_ns)])
        return track

    straight, turned_left, turned_right = leg(0.5, 0.2), leg(0.0, math.pi), leg(0.0, -math.pi)
    leg(0.0, 0.5 * math.pi)
    return STAGES[-1].evaluate(FloorSeen(straight, turned_left, turned_right, leg(0.25, 0.1)), written)


@thinned(
    ("origin", "offset", "yaw_offset_rad"),
    list(product([(0.0, 0.0, 0.0), PLACE["origin"]], [(0.0, 0.0), OFFSET], [0.0, 2.0])),
    quick=2,
)
def test_a_right_robot_toml_is_right_in_all_units_and_axes(shipped, origin, offset, yaw_offset_rad):
    ahead_m = offset[0] - X_ICR_M
    for units in UNITS:
        place = {"origin": origin, "offset": offset, "latency_s": LATENCY_S}
        right = with_pose(shipped, **units, **place, yaw_offset_rad=yaw_offset_rad)
        found = floor_drive(right, right)
        assert not found.faults, units
        assert (
            f"{abs(ahead_m):.2f} m {'ahead of' if ahead_m > 0.0 else 'behind'} and {offset[1]:.2f} m"
            in found.figures[2]
        )
        assert "(x_icr_m = 0.12)" in found.figures[2], units
        assert "100 ms old on arrival, their stamps 0 ms" in found.figures[3]
        assert len(found.figures) == 4


@FEW_AND_ALL
@pytest.mark.parametrize("name", [*VALUES, "yaw_offset_rad"])
def test_a_wrong_field_is_named_with_the_value_that_is_right_beside_the_others(shipped, name, all_units):
    for units in all_units:
        fields = {**units, **PLACE, "yaw_offset_rad": 0.7}
        for wrong in {*VALUES.get(name, (2.0, -1.0))} - {fields[name]}:
            found = floor_drive(with_pose(shipped, **fields), with_pose(shipped, **{**fields, name: wrong}))
            assert found.edits == pytest.approx({("pose", name): fields[name]}, abs=5e-3), (units, wrong)


@FEW_AND_ALL
def test_all_wrong_fields_together_become_those_of_the_sensor(shipped, all_units):
    for units in all_units:
        right, written = with_pose(shipped, **units, **PLACE, yaw_offset_rad=0.7), with_pose(shipped, **PLACE)
        edits = {name: value for (_, name), value in floor_drive(right, written).edits.items()}
        assert edits.pop("yaw_offset_rad") == pytest.approx(0.7, abs=5e-3), units
        assert edits.items() == units.items() - UNITS[0].items()


def test_a_yaw_offset_that_is_as_near_as_a_short_drive_shows_is_believed(shipped):
    assert not floor_drive(with_pose(shipped, yaw_offset_rad=0.1), with_pose(shipped, yaw_offset_rad=0.25)).faults


def test_a_fence_in_another_frame_than_that_of_the_poses_as_sent_is_not_in_force(tmp_path, path, monkeypatch, capsys):
    path.write_text(
        path.read_text(encoding="utf-8") + "[fence]\nkeep_in = [[-2, -2], [2, -2], [2, 2], [-2, 2]]\n", encoding="utf-8"
    )
    assert load_setup(path).config.fence.is_set
    assert not as_sent(load_setup(path)).config.fence.is_set
    monkeypatch.setattr("os.isatty", lambda _descriptor: True)
    for stages, is_said in ((("turns",), False), (("floor",), True)):
        with pytest.raises(EOFError):
            run_commission(CommissionOptions(path, stages=stages, log_directory=tmp_path / "logs"), goes_away)
        assert ("not in force in the stage floor" in capsys.readouterr().err) is is_said


def test_a_robot_toml_that_an_editor_marked_as_utf_8_is_corrected(path):
    text = path.read_text("utf-8")
    path.write_text(text[text.index("[robot]") :], "utf-8-sig")
    assert write_fields(CommissionOptions(path, write=True), {("robot", "name"): "other"})
    assert load_setup(path).config.robot.name == "other"


@pytest.mark.long
def test_an_encoder_that_does_not_count_is_named_and_nothing_is_written(tmp_path):
    # The reference firmware notices by itself; an ODrive's simulator does not look.
    with pytest.raises(WorkError, match="ENCODER_MISSING_RIGHT"):
        evaluated(robot_file(tmp_path), "sides", Miswiring(dead_encoders=(1,)))
    evaluation, _ = evaluated(robot_file(tmp_path, "odrive"), "sides", Miswiring(dead_encoders=(1,)))
    assert [fault.name for fault in evaluation.faults] == ["encoder dead"]
    assert "right" in evaluation.faults[0].text
    assert not evaluation.edits


def lifted(_x, _y, _yaw):
    """Poses of a robot whose wheels are off the ground."""
    return 0.3, -0.2, 0.5


def assert_driven_to_the_end(run):
    events = [record.text for _, records in run.recorder.ticks for record in records if isinstance(record, Event)]
    assert not [text for text in events if "task stopped" in text]


# The robot whose watchdog is off is on blocks, too.
@pytest.mark.parametrize("name", ["sides", pytest.param("turns", marks=pytest.mark.thorough)])
def test_a_robot_on_blocks_is_driven_to_the_end_though_its_poses_stand_still(tmp_path, name):
    evaluation, run = evaluated(coarse_file(tmp_path), name, Miswiring(pose=lifted), **COARSE)
    assert not evaluation.faults
    assert_driven_to_the_end(run)


def after(seconds, wanted):
    """Whether what is wanted of a pilot has been so for this long, by the times it is asked with."""
    since = []

    def holds(pilot, now_ns):
        if wanted(pilot):
            since.append(now_ns)
        return bool(since) and now_ns - since[0] > 1e9 * seconds

    return holds


def silent(pilot):
    return isinstance(pilot.procedure.action, Silence)


def watchdog(robot, slowest_rad_s):
    """The end of the stage `turns`."""
    return procedure._watchdog((procedure.speed_of(robot, slowest_rad_s),) * 2)


def question(_robot, _slowest_rad_s):
    """A question that the simulated operator does not answer."""
    yield Prompt("was that right? y yes", "y")


# What is driven with which controller, and when somebody presses the e-stop.
PRESSED = {
    "before it is ready": (procedure.sides, "reference", lambda _pilot, now_ns: now_ns > 0),
    "driving": (procedure.sides, "odrive", after(1.0, lambda pilot: pilot._driving)),
    "asked": (question, "odrive", after(0.5, lambda pilot: isinstance(pilot.procedure.action, Prompt))),
    "driving a turn": (procedure.turns, "agilex", after(0.5, lambda pilot: pilot._driving)),
    "driving on the floor": (procedure.floor, "vesc", after(1.5, lambda pilot: pilot._driving)),
    "silent": (watchdog, "odrive", after(1.0, silent)),
    "a fault is cleared": (watchdog, "odrive", lambda pilot, _now_ns: isinstance(pilot.procedure.action, Reset)),
}


@pytest.mark.parametrize("when", PRESSED)
def test_an_e_stop_ends_a_stage_and_stays(tmp_path, monkeypatch, when):
    steps, driver, is_pressed = PRESSED[when]
    if when == "silent":
        monkeypatch.setattr(odrive.Axis, "check_watchdog", lambda *_args: None)
    pressed, resets, outputs = [], [], []

    class Pilot(CommissionPilot):
        def step(self, now_ns, last):
            desired = super().step(now_ns, last)
            if pressed:
                resets.extend(r for r in desired.requests if r is UserRequest.RESET)
            elif is_pressed(self, now_ns):
                pressed.append(now_ns)
                desired = replace(desired, requests=(*desired.requests, UserRequest.ESTOP))
            return desired

        def learn(self, now_ns, tick, replies):
            super().learn(now_ns, tick, replies)
            outputs.append(tick.output)

    monkeypatch.setattr("tests.first_use.miswired.CommissionPilot", Pilot)
    with pytest.raises(WorkError, match=r"e-stop requested by the operator; correct it, then reset"):
        stage(coarse_file(tmp_path, driver), steps, Miswiring(pose=lifted), **COARSE)
    assert not resets
    # The daemon ends with it, so it must have arrived.
    assert outputs[-1].estop
    assert not outputs[-1].send_estop


def test_a_watchdog_that_is_off_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr(odrive.Axis, "check_watchdog", lambda *_args: None)
    evaluation, run = evaluated(coarse_file(tmp_path, "odrive"), "turns", Miswiring(pose=lifted), **COARSE)
    assert [fault.name for fault in evaluation.faults] == ["watchdog off"]
    assert_driven_to_the_end(run)


def sound(number):
    """A robot as they come: other geometry, lag, dead band, noise."""
    draw = random.Random(number)
    plant = PlantParameters(
        wheel_radius_m=0.06 * draw.uniform(0.9, 1.1),
        axial_distance_m=0.31 * draw.uniform(1.0, 2.0),
        x_icr_m=draw.uniform(-0.1, 0.25),
        pose_position_std_m=draw.uniform(0.001, 0.01),
        pose_yaw_std_rad=draw.uniform(0.002, 0.02),
        pose_delay_s=draw.uniform(0.01, 0.15),
        pose_rate_hz=draw.choice([10.0, 25.0, 50.0]),
    )
    effects = draw.choice(
        [{}, {"motor_lag": 0.15}, {"deadband": 0.5}, {"command_delay": 0.15}, {"encoder_scale": 0.03}]
    )
    return plant, effects


@pytest.mark.long
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("number", range(20))
def test_twenty_sound_robots_have_no_fault(tmp_path, number):
    path, (plant, effects) = robot_file(tmp_path, DRIVERS[number % len(DRIVERS)]), sound(number)
    assert commissioned(path, Miswiring(), plant=plant, effects=effects, seed=number) == []


@pytest.mark.long
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("driver", DRIVERS)
@pytest.mark.parametrize("wrong", WRONG)
def test_every_fault_is_found_with_every_driver(tmp_path, driver, wrong):
    assert commissioned(robot_file(tmp_path, driver), WRONG[wrong]) == [wrong.removesuffix(" the other way")]


@pytest.mark.long
def test_axes_of_north_and_east_are_two_faults_for_each_is_a_field_of_its_own(path):
    assert commissioned(path, Miswiring(pose=north_and_east)) == ["yaw the other way round", "axes mirrored"]


def test_who_holds_a_key_that_does_not_count_is_told_once(path):
    class Idle:
        ended = None

        def poll(self, _now_ns, _robot):
            return None

    ineffective = [False, True, True, False, True]
    readings = iter(ineffective)
    steps = Procedure(STAGES[0].steps(load_setup(path).config.robot, 0.0))
    pilot = CommissionPilot(steps, Idle(), str, lambda: next(readings))
    messages = [
        [text for text in pilot.step(k, None).events if "release all keys" in text] for k in range(len(ineffective))
    ]
    assert list(map(len, messages)) == [0, 1, 0, 0, 1]


SWAPPED = {("wheels", "sides_swapped"): True}


def test_nothing_is_written_without_a_yes_or_of_what_would_be_refused(path):
    before = path.read_text(encoding="utf-8")
    assert not write_fields(CommissionOptions(path), SWAPPED, ask=lambda _prompt: "")
    with pytest.raises(WorkError, match="not changed"):
        write_fields(CommissionOptions(path, write=True), {("wheels", "turn_ratio"): -1.0})
    assert path.read_text(encoding="utf-8") == before


def test_the_file_of_before_is_kept_byte_for_byte(path):
    before = path.read_bytes().replace(b"\n", b"\r\n")
    path.write_bytes(before)
    assert write_fields(CommissionOptions(path, write=True), SWAPPED)
    assert path.with_name(f"{path.name}.before").read_bytes() == before
    assert load_setup(path).config.wheels.sides_swapped


def test_a_place_that_cannot_be_written_is_one_line_and_leaves_robot_toml(tmp_path, path):
    before = path.read_bytes()
    path.with_name(f"{path.name}.before").mkdir()
    there = sorted(tmp_path.iterdir())
    with pytest.raises(WorkError, match=r"not changed \(Is a directory\)"):
        write_fields(CommissionOptions(path, write=True), SWAPPED)
    assert path.read_bytes() == before
    assert sorted(tmp_path.iterdir()) == there


def test_logs_that_could_not_be_kept_are_refused_before_anybody_is_asked(path):
    with pytest.raises(InputError, match=r"exists and is not a directory"):
        run_commission(CommissionOptions(path, log_directory=path))


def test_of_several_pose_sources_the_first_alone_is_looked_at_which_is_said(tmp_path, path, monkeypatch, capsys):
    path.write_text(path.read_text(encoding="utf-8") + '[[pose.also]]\nsource = "robot"\n', encoding="utf-8")
    setup = load_setup(path)
    assert (len(setup.config.pose.also), as_sent(setup).config.pose.also) == (1, ())
    monkeypatch.setattr("os.isatty", lambda _descriptor: True)
    with pytest.raises(EOFError):
        run_commission(CommissionOptions(path, log_directory=tmp_path / "logs"), goes_away)
    assert "only the first source is examined" in capsys.readouterr().err
