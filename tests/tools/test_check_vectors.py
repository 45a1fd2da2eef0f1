"""The check against vendors' test vectors: that it finds a difference, and all cases of a folder where there is one.

The vectors are not part of this project: DISCO_HW_VENDOR_VECTORS names their folder.
"""

import json
import os

import pytest

from tools.vectors.check import CHECKS, main

FOLDER = os.environ.get("DISCO_HW_VENDOR_VECTORS")
VELOCITY = {
    "case": "set_input_vel:01",
    "kind": "host_to_device",
    "given": {"nodes": [3, 5], "node": 3, "command": "Set_Input_Vel", "vel_turns_s": 1.5, "torque_nm": 0.0},
    "frames": [{"id": 0x6D, "extended": False, "data": "0000c03f00000000"}],
    "then": {
        "changed": {"3": {"input_vel_turns_s": 1.5, "input_torque_nm": 0.0}},
        "watchdog_fed_nodes": [3],
        "replies": [],
    },
}
ERPM = {
    "case": "set_erpm:01",
    "kind": "host_to_device",
    "given": {"controller_id": 23, "command": "set_erpm", "value": 3000.6},
    "frames": [{"id": 0x317, "extended": True, "data": "00000bb8"}],
    "then": {"motor_calls": [["set_erpm", 3000.0]], "timeout_fed": True, "replies": []},
}


def write(folder, name, *cases):
    (folder / f"{name}.jsonl").write_text("".join(json.dumps(case) + "\n" for case in cases))


def test_cases_that_agree(tmp_path, capsys):
    write(tmp_path, "odrive056", VELOCITY)
    write(tmp_path, "vesc_can", ERPM)
    write(tmp_path, "unheard_of", {"case": "x:1"})
    assert main([str(tmp_path)]) == 0
    output = capsys.readouterr().out
    assert "odrive056.jsonl: 1 of 1 agree, 0 of them within rounding" in output
    assert "vesc_can.jsonl: 1 of 1 agree, 1 of them within rounding" in output
    assert "unheard_of.jsonl: no driver here speaks this protocol" in output


@pytest.mark.parametrize(
    ("field", "value", "expected_text"),
    [
        ("frames", [{"id": 0x6D, "extended": False, "data": "0000c03f00000001"}], "frame"),
        ("then", {**VELOCITY["then"], "watchdog_fed_nodes": [5]}, "fed"),
        ("then", {**VELOCITY["then"], "changed": {}}, "changed"),
        ("given", {}, "cannot be run"),
    ],
)
def test_a_case_that_disagrees_is_named(tmp_path, capsys, field, value, expected_text):
    write(tmp_path, "odrive056", VELOCITY, {**VELOCITY, field: value, "case": "odd:02"})
    assert main([str(tmp_path)]) == 1
    out = capsys.readouterr().out
    assert "1 of 2 agree" in out
    assert any(line.startswith("  odd:02: ") and expected_text in line for line in out.splitlines())


def test_a_folder_without_vectors_is_refused(tmp_path, capsys):
    assert main([str(tmp_path)]) == 2
    assert "no vectors" in capsys.readouterr().err
    assert main([str(tmp_path / "none")]) == 2


@pytest.mark.skipif(FOLDER is None, reason="DISCO_HW_VENDOR_VECTORS does not name a folder of vectors")
def test_every_case_of_the_vendors_agrees(capsys):
    assert main([str(FOLDER)]) == 0, capsys.readouterr().out
    output = capsys.readouterr().out
    assert all(f"{name}.jsonl" in output for name in CHECKS)
