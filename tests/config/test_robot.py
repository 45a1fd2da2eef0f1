"""Tests of robot.toml: what is accepted, and the one line that a mistake gets."""

from __future__ import annotations

import math
import re
from pathlib import Path

import msgspec
import pytest

from disco_hw.config import SHIPPED_ROBOT, Prior, load_robot_config
from disco_hw.errors import InputError
from disco_hw.fence import Footprint
from disco_hw.tasks import kinds, task_class
from disco_hw.tasks.circle import circle_task
from disco_hw.tasks.path import PathTask
from disco_hw.tasks.timed_path import TimedPathTask
from drivers.motor import motor_drivers

GOOD = """
[robot]
name = "wombot"
wheel_radius_m = 0.06
axial_distance_m = 0.31
ticks_per_rev = 2048
max_wheel_speed_rad_s = 8.0
"""


def load(tmp_path: Path, text: str):
    path = tmp_path / "robot.toml"
    path.write_text(text, encoding="utf-8")
    return load_robot_config(path)


def test_minimal_file_gets_the_papers_task(tmp_path):
    config = load(tmp_path, GOOD)
    assert config.robot.wheel_radius_m == 0.06
    assert config.task.radius_m == 0.75
    assert config.task.speed_m_s == 0.2


def test_the_prior_is_around_the_robot_where_the_file_leaves_it_out(tmp_path):
    prior = load(tmp_path, GOOD.replace("name =", "x_icr_m = 0.1\nname =")).prior
    assert prior.wheel_radius_m == pytest.approx((0.03, 0.09))
    assert prior.axial_distance_m == pytest.approx((0.155, 0.93))
    assert prior.x_icr_m == pytest.approx((-0.21, 0.41))
    given = load(tmp_path, GOOD + "[prior]\nx_icr_m = [0.0, 0.5]\n").prior
    assert (given.x_icr_m, given.wheel_radius_m) == ((0.0, 0.5), pytest.approx((0.03, 0.09)))


def test_the_papers_robot_has_the_papers_prior():

    config = load_robot_config(SHIPPED_ROBOT)
    assert config.prior == Prior()


def test_shipped_robot_file_is_valid():

    config = load_robot_config(SHIPPED_ROBOT)
    assert config.link.interface == "unixcan"


@pytest.mark.parametrize(
    ("change", "fragments"),
    [
        (("wheel_radius_m = 0.06\n", ""), ["wheel_radius_m", "missing", "add"]),
        (("wheel_radius_m", "weel_radius_m"), ["weel_radius_m", "no such field", "did you mean wheel_radius_m?"]),
        (("wheel_radius_m = 0.06", "wheel_radius_m = -1.0"), ["robot.wheel_radius_m", "> 0.0"]),
        (("wheel_radius_m = 0.06", "wheel_radius_m = nan"), ["wheel_radius_m"]),
        (("wheel_radius_m = 0.06", 'wheel_radius_m = "six"'), ["robot.wheel_radius_m", "str", "float"]),
        (("ticks_per_rev = 2048", "ticks_per_rev = true"), ["robot.ticks_per_rev", "bool", "float"]),
        (("[robot]", "[robott]"), ["robott", "no such field"]),
        (("[robot]", "[robot"), ["not valid TOML", "line"]),
        (("ticks_per_rev = 2048", "ticks_per_rev = " + "1" * 5000), ["not valid TOML", "line 6", "64 characters"]),
        (("ticks_per_rev = 2048", "ticks_per_rev = " + "[" * 3000 + "]" * 3000), ["line 6", "16 deep"]),
        (("max_wheel_speed_rad_s = 8.0", "max_wheel_speed_rad_s = 2.0"), ["task.speed_m_s", "wheels"]),
    ],
)
def test_a_mistake_gets_one_line_with_file_and_field(tmp_path, change, fragments):
    with pytest.raises(InputError) as caught:
        load(tmp_path, GOOD.replace(*change))
    message = str(caught.value)
    assert "\n" not in message
    assert message.startswith(str(tmp_path / "robot.toml"))
    for fragment in fragments:
        assert fragment in message


@pytest.mark.parametrize(
    ("extra", "field"),
    [
        ("[prior]\nx_icr_m = [0.5, 0.0]\n", "prior.x_icr_m"),
        ("[prior]\nx_icr_m = [0.0, inf]\n", "prior.x_icr_m"),
        ("[control]\nrate_hz = 500.0\n", "control.rate_hz"),
        ("[control]\nseed = 99999999999999999999\n", "control.seed"),
        ("[task]\ncenter_y_m = -4600000.0\n", "task.center_y_m"),
        ("[task]\ncenter_x_m = 500.0\nradius_m = 338.1\n", "task.center_x_m"),
        ("[control]\nrate_hz = 20.0\ncommand_valid_for_s = 0.05\n", "control.command_valid_for_s"),
        ("[control]\ntelemetry_zero_s = 0.2\n", "control.telemetry_disarm_s"),
        ("[control]\nsamples = 1000000\nhorizon = 500\n", "control.samples: 500000000 steps"),
        ("[control]\nsamples = 400000\n", "write at most 40000, or set control.horizon"),
        ("[control]\nrate_hz = 30.0\nstep_s = 0.033\n", "control.step_s: 0.033 s is shorter than a control period"),
        ("[control]\nseed = 9223372036854775808\n", "control.seed"),
        ('[link]\nkind = "wifi"\n', "link.kind"),
        ('[task]\nkind = "square"\n', "task"),
        (
            '[task]\nkind = "spiral"\n',
            "task.kind: 'spiral' is not a kind of task; write one of circle, lemniscate, path",
        ),
        ("[estimation]\npose_timeout_s = inf\n", "estimation.pose_timeout_s"),
        (
            "[pose]\nlatency_s = 1.0\n",
            "pose.latency_s: poses that are 1 s old are refused, as estimation.history_s is 1",
        ),
        ('[[pose.also]]\nsource = "udp"\nlatency_s = 1.2\n', "pose.also[0].latency_s: poses that are 1.2 s old"),
        ('[model]\nfile = "a\\u0000b.toml"\n', "model.file: holds a NUL"),
    ],
)
def test_ranges_and_relations_are_checked(tmp_path, extra, field):
    with pytest.raises(InputError, match=re.escape(field)):
        load(tmp_path, GOOD + extra)


@pytest.mark.parametrize(
    ("escape", "expected"), [(r"\u0000", "a NUL"), (r"\n", r"control character '\n'"), (r"\u001b", "control")]
)
@pytest.mark.parametrize("place", ["log.directory", "daemon.control_socket", "robot.name"])
def test_no_name_holds_a_control_character(tmp_path, place, escape, expected):
    section, field = place.split(".")
    text = f'{field} = "/tmp/a{escape}b"'
    text = GOOD.replace('name = "wombot"', text) if section == "robot" else f"{GOOD}[{section}]\n{text}\n"
    with pytest.raises(InputError) as error:
        load(tmp_path, text)
    assert f"robot.toml: {place}: holds " in str(error.value)
    assert expected in str(error.value)
    assert "\n" not in str(error.value)


def test_unreadable_file(tmp_path):
    with pytest.raises(InputError, match="cannot be read"):
        load_robot_config(tmp_path / "none.toml")


def test_every_field_is_documented():
    from disco_hw.config import RobotConfig

    text = (Path(__file__).parents[2] / "docs" / "robot.md").read_text(encoding="utf-8")
    for section in RobotConfig.__struct_fields__:
        assert f"[{section}]" in text
        for field in _fields_of(section):
            # `of_driver` is what the driver's own fields become, not a field to write.
            assert field == "of_driver" or f"\n| `{field}` | " in text, f"[{section}] {field}"
    for driver in motor_drivers().values():
        for field in driver.settings.__struct_fields__:
            assert f"\n| `{field}` | " in text, f"{driver.name}: {field}"


def test_the_page_on_controllers_has_a_link_for_each_that_loads(tmp_path):
    page = (Path(__file__).parents[2] / "docs" / "controllers.md").read_text(encoding="utf-8")
    links = re.findall(r"^```toml\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
    drivers = [load(tmp_path, GOOD + link).link.driver for link in links]
    assert sorted(drivers) == sorted(set(motor_drivers()) - {"reference"})


def _fields_of(section: str) -> tuple[str, ...]:
    import typing

    from disco_hw.config import RobotConfig

    if section == "task":
        classes = [task_class(kind) for kind in kinds()]
        # What is read from the task's file is no field.
        return tuple({name for found in classes for name in found.__struct_fields__ if name not in found.read_fields})
    return tuple(typing.get_type_hints(RobotConfig)[section].__struct_fields__)


def test_every_kind_of_task_is_documented():
    text = (Path(__file__).parents[2] / "docs" / "robot.md").read_text(encoding="utf-8")
    for kind in kinds():
        assert f'kind = "{kind}"' in text, kind


@pytest.mark.parametrize("kind", ["", 'kind = "path"\n'])
def test_a_path_is_named_in_the_task_with_or_without_its_kind(tmp_path, kind):
    task = load(tmp_path, GOOD + f'[task]\n{kind}path = "a/b.csv"\nspeed_m_s = 0.3\n').task
    assert task == PathTask(path="a/b.csv", speed_m_s=0.3)
    with pytest.raises(InputError, match="--script circle needs a circle: write kind"):
        circle_task(task, "--script circle")


@pytest.mark.parametrize(
    ("task", "message"),
    [
        (
            'path = "p.csv"\nradius_m = 1.0\n',
            r'task\.radius_m: belongs to the kind "circle", but task\.kind is "path"; '
            'write kind = "circle", or remove it$',
        ),
        (
            'kind = "circle"\npath = "p.csv"\n',
            r'task\.path: belongs to the kind "path" or "timed_path", but task\.kind is "circle"; '
            "write kind = one of those, or remove it$",
        ),
        ('kind = "lemniscate"\nradus_m = 1.0\n', r"radus_m: no such field; check the spelling or remove it"),
        ('kind = "circle"\npoints = [[0.0, 0.0]]\n', "points: no such field; check the spelling or remove it"),
        ('kind = "path"\n', "path: missing; add it"),
        ('path = ""\n', "task.path: expected `str` of length >= 1"),
        ('path = "p.csv"\npoints = [[0.0, 0.0]]\n', "points: no such field; write way-points in a CSV"),
        ('path = "p.csv"\nspeed_m_s = 0.5\n', "task.speed_m_s: 0.5 m/s is above what the wheels can do"),
        (
            'kind = "timed_path"\npath = "p.csv"\nspeed_m_s = 0.2\n',
            r'task\.speed_m_s: belongs to the kind "circle", "lemniscate" or "path", but task\.kind is "timed_path"; ',
        ),
        ('kind = "timed_path"\n', "path: missing; add it"),
        ('kind = "timed_path"\npath = "p.csv"\ntimes_s = [0.0]\n', "times_s: no such field; write way-points in a CSV"),
    ],
)
def test_a_mistake_in_a_path_task_gets_one_line(tmp_path, task, message):
    with pytest.raises(InputError, match=message) as caught:
        load(tmp_path, GOOD + "[task]\n" + task)
    assert "\n" not in str(caught.value)


def test_way_points_by_time_are_asked_for_by_their_kind(tmp_path):
    task = load(tmp_path, GOOD + '[task]\nkind = "timed_path"\npath = "p.csv"\n').task
    assert (task, task.speed_m_s) == (TimedPathTask(path="p.csv"), 0.0)
    read = TimedPathTask(path="p.csv", points=((0.0, 0.0), (1.0, 0.0), (1.0, 0.3)), times_s=(1.0, 6.0, 7.0))
    assert read.speed_m_s == pytest.approx(0.3)
    with pytest.raises(InputError, match="needs a circle"):
        circle_task(read, "--script circle")


def test_every_form_of_uncertainty_can_be_asked_for(tmp_path):
    for name in ("ut", "mc", "joint", "point"):
        assert load(tmp_path, GOOD + f'[control]\nuncertainty = "{name}"\n').control.uncertainty == name
    with pytest.raises(InputError, match=r"control\.uncertainty: .*'both'"):
        load(tmp_path, GOOD + '[control]\nuncertainty = "both"\n')


def test_way_points_by_time_take_no_fallback(tmp_path):
    (tmp_path / "way.csv").write_text("t_s,x_m,y_m\n0,0,0\n10,1,0\n20,2,0\n")
    file = tmp_path / "robot.toml"
    task = '[task]\nkind = "timed_path"\npath = "way.csv"\n'
    file.write_text(GOOD.split("[task]", maxsplit=1)[0] + task + '[control]\nfallback = "lqr"\n')
    with pytest.raises(InputError, match=r"control\.fallback: way-points with times have no single speed"):
        load_robot_config(file)
    file.write_text(file.read_text().replace('"lqr"', '"ramp"'))
    assert load_robot_config(file).control.fallback == "ramp"


def test_a_robot_that_drives_backwards_starts_with_its_back_to_where_the_line_goes(tmp_path):
    forwards, backwards = (load(tmp_path, GOOD + control) for control in ("", '[control]\nfacing = "backwards"\n'))
    *place, yaw_rad = forwards.task.course().start
    assert forwards.task_start == (*place, yaw_rad)
    assert backwards.task_start == pytest.approx((*place, yaw_rad + math.pi))
    assert (forwards.turned_rad, backwards.turned_rad) == (0.0, math.pi)
    robot = msgspec.structs.replace(forwards.robot, footprint_m=Footprint(0.6, 0.4, 0.1))
    seen = [msgspec.structs.replace(config, robot=robot).footprint_along_line.ahead for config in (forwards, backwards)]
    assert seen == [0.1, -0.1]


@pytest.mark.parametrize(
    ("with_it", "expected_error"),
    [
        ('mode = "paper"', r"control\.facing: the paper's cost knows of no facing; write mode = \"default\""),
        ('fallback = "lqr"', r"control\.facing: .* drives forwards; write fallback = \"ramp\""),
    ],
)
def test_the_paper_and_other_laws_drive_forwards_only(tmp_path, with_it, expected_error):
    for facing in ("forwards", "backwards"):
        text = GOOD + f'[control]\nfacing = "{facing}"\n{with_it}\n'
        if facing == "forwards":
            load(tmp_path, text)
            continue
        with pytest.raises(InputError, match=expected_error):
            load(tmp_path, text)
