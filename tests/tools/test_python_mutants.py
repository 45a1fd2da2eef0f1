"""The sweep takes an hour (`python -m tools.python_mutants`); here, what it changes, and that its list is sound."""

import tomllib
from pathlib import Path

import pytest

from drivers.motor import find_driver
from tests.drivers.motor import test_vendor_frames
from tools.python_mutants import EQUIVALENTS, ROOT, Trial, module_name, mutants, touched_by


def changes(source):
    return [(placed.mutant.old, placed.mutant.new) for placed in mutants(source)]


def test_comparisons_logic_and_conditions():
    assert changes("a < b <= c") == [("<", "<="), ("<", ">="), ("<=", "<"), ("<=", ">")]
    assert changes("a is not b or c in d") == [("or", "and"), ("is not", "is"), ("in", "not in")]
    assert changes("x = y if ready else z") == [("ready", "(not (ready))")]
    assert changes("[a for a in b if not a]") == [("not", "")]
    assert changes("while go:\n    break") == [("break", "continue")]


def test_arithmetic_numbers_and_extremes():
    assert changes("x = 2 * -y") == [("*", "/"), ("2", "3"), ("2", "1"), ("-", "")]
    assert changes("x -= 0") == [("-=", "+="), ("0", "1"), ("0", "(-1)")]
    assert changes("x = min(2.0, 0.0, 1e-9)") == [("min", "max"), ("2.0", "2.5"), ("2.0", "1.6"), ("0.0", "0.5")]
    assert changes("x = np.maximum(a @ b, True)") == [("maximum", "minimum"), ("@", "*"), ("True", "False")]


def test_what_changes_no_result_is_left_alone():
    assert changes('"""1 + 1"""\n@dataclass(frozen=True)\nclass A:\n    x: Literal[1]\n') == []
    assert changes('assert a < 1\nf"{a + 1}"\nzip(a, b, strict=True)  # 1 + 1\n') == []


def test_a_change_of_what_runs_on_import_is_tried_with_all_tests():
    placed = mutants("A = 1\n\ndef f(x=2):\n    return 3\n\n@kernel_function\ndef g():\n    return 4\n")
    assert [(one.mutant.old, one.on_import, sorted(one.lines)) for one in placed[::2]] == [
        ("1", True, [1]), ("2", True, [3]), ("3", False, [4]), ("4", True, [8]),
    ]  # fmt: skip


@pytest.mark.parametrize(("changed", "noticed"), [('"set_erpm": (4,', True), ('"set_erpm":  (3,', False)])
def test_a_module_that_its_package_hands_out_is_tried_as_changed(tmp_path, changed, noticed):
    """In the package's own files, which find it in their folder, and in a test that imports it from there."""
    path = ROOT / "drivers" / "motor" / "vesc_codec.py"
    source, name = path.read_text("utf-8"), module_name(path)
    mutant = source.replace('"set_erpm": (3,', changed)
    assert mutant != source
    assert find_driver("vesc") is not None
    touched = touched_by(name)
    assert "drivers.motor" in touched
    test = test_vendor_frames.test_a_command_is_the_documented_frame_held_to_what_the_wire_can_say.__name__
    tests = [f"{ROOT / 'tests' / 'drivers' / 'motor' / 'test_vendor_frames.py'}::{test}"]
    assert Trial(name, path, touched, tmp_path).killed(mutant, tests) is noticed


@pytest.mark.parametrize(("name", "reasons"), tomllib.loads(EQUIVALENTS.read_text("utf-8")).items())
def test_every_listed_equivalent_is_still_a_mutant_and_has_its_reason(name, reasons):
    keys = {placed.mutant.key for placed in mutants(Path(ROOT / name).read_text("utf-8"))}
    assert set(reasons) <= keys, "the line has changed: judge the mutant anew"
    assert all(len(reason.split()) >= 4 for reason in reasons.values())
