"""The kinds of tasks: found by their files, looked up once, and named nowhere else."""

from __future__ import annotations

import ast
from functools import cache
from pathlib import Path

import msgspec
import pytest

import disco_hw
from disco_hw.config import Robot
from disco_hw.tasks import ReadField, UnknownKind, default_task, kind_of, kinds, task_class, task_from
from disco_hw.tasks.circle import CircleTask
from disco_hw.tasks.lemniscate import LemniscateTask
from disco_hw.tasks.path import PathTask

PACKAGE = Path(disco_hw.__file__).parent
# The experiments are the paper's and ours on the circle, and one of the scripts to drive by hand is its circle. A log's
# path, as the recorder's status holds it, is no task.
ELSEWHERE = {
    "circle": ("experiments/", "drive/scripts.py"),
    # The word is the name of a field there: of the way-points' file, of a reply.
    "path": ("daemon/__init__.py", "viewer/panel.py"),
}


def test_every_file_with_a_task_is_a_kind():
    assert kinds() == ("circle", "lemniscate", "path", "timed_path")
    for kind in kinds():
        assert task_class(kind).__module__ == f"disco_hw.tasks.{kind}"


def test_what_goes_without_saying():
    assert default_task() == CircleTask()
    assert task_from({"radius_m": 0.5}) == CircleTask(radius_m=0.5)
    assert task_from({"path": "a.csv"}) == PathTask(path="a.csv")
    assert kind_of(task_from({"kind": "lemniscate"})) == "lemniscate"


@pytest.mark.parametrize("kind", ["spiral", "task", "registry", "cost", "line", "__init__", "circle.py", "", 3, None])
def test_another_kind_is_refused_with_those_that_there_are(kind):
    section = {"kind": kind}
    if kind is None:
        assert task_from(section) == CircleTask()
        return
    with pytest.raises(UnknownKind, match="is not a kind of task; write one of circle, lemniscate, path, timed_path"):
        task_from(section)


def test_fields_are_those_of_the_kind():
    with pytest.raises(msgspec.ValidationError, match="unknown field `radius_m`"):
        task_from({"kind": "lemniscate", "radius_m": 1.0})
    with pytest.raises(msgspec.ValidationError, match="size_m"):
        task_from({"kind": "lemniscate", "size_m": 0.0})
    with pytest.raises(ReadField, match="points: no such field"):
        task_from({"path": "a.csv", "points": [[0.0, 0.0]]})


def names_in(text: str) -> frozenset[str]:
    """All whole texts that a module says, modules that it imports from, and names that it uses."""
    found = set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            found.add(repr(node.value))
        elif isinstance(node, ast.ImportFrom):
            found.add(f"from {node.module}")
        elif isinstance(node, ast.Name):
            found.add(node.id)
    return frozenset(found)


@cache
def text_of(path: Path) -> str:
    return path.read_text("utf-8")


def is_named_in(names: frozenset[str], kind: str, classes: set[str]) -> bool:
    """Whether a module says a kind's name as a whole text, imports its file or names one of its classes."""
    return not names.isdisjoint({repr(kind), f"from disco_hw.tasks.{kind}", *classes})


@pytest.mark.parametrize("kind", kinds())
def test_a_kind_is_named_in_its_own_file_alone(kind):
    task_file = PACKAGE / "tasks" / f"{kind}.py"
    classes = {node.name for node in ast.parse(task_file.read_text("utf-8")).body if isinstance(node, ast.ClassDef)}
    found = set()
    for path in PACKAGE.rglob("*.py"):
        name = path.relative_to(PACKAGE).as_posix()
        if path != task_file and not name.startswith(ELSEWHERE.get(kind, ())):
            # Most files have none of the words, and reading a file as Python takes longest.
            has_words = any(word in text_of(path) for word in (f'"{kind}"', f"'{kind}'", f"tasks.{kind} ", *classes))
            found |= {name} if has_words and is_named_in(names_in(text_of(path)), kind, classes) else set()
    for path in PACKAGE.rglob("*.html"):
        found |= {path.name} if f'"{kind}"' in text_of(path) else set()
    assert found == set()


def test_a_name_in_another_file_is_found():
    for text in ('kind == "circle"', "from disco_hw.tasks.circle import TASK", "isinstance(task, CircleTask)"):
        assert is_named_in(names_in(text), "circle", {"CircleTask"})
    assert not is_named_in(names_in('"""Drive a circle."""\nradius = "circle of 1 m"'), "circle", {"CircleTask"})


def test_the_lemniscate_crosses_itself_in_its_middle_and_is_as_large_as_it_says():
    task = LemniscateTask(center_x_m=1.0, center_y_m=-0.5, size_m=2.0)
    x, y = task.course().outline_m().T
    assert (x.min(), x.max()) == pytest.approx((-1.0, 3.0))
    assert (y.min(), y.max()) == pytest.approx((-0.5 - 2.0**-0.5, -0.5 + 2.0**-0.5), abs=1e-3)
    assert task.points()[0] == task.points()[-1] == pytest.approx((1.0, -0.5))
    assert task.course().length_m == pytest.approx(5.2441 * 2.0, rel=1e-3)
    robot = Robot(
        name="r", wheel_radius_m=0.06, axial_distance_m=0.31, x_icr_m=-0.2, ticks_per_rev=2048,
        max_wheel_speed_rad_s=8.0,
    )  # fmt: skip
    assert LemniscateTask(size_m=0.48).beyond_robot(robot) is None
    fault = LemniscateTask(size_m=0.47).beyond_robot(robot)
    assert (fault.field, fault.hint) == ("size_m", "write at least 0.48")
    assert task.editable(robot)["size_m"].low == 0.48
    assert "with this size_m the figure reaches" in LemniscateTask(center_x_m=830.0, size_m=10.0).fault().fault
