"""The page for whoever writes the other end says what the code does."""

import re
from pathlib import Path

import pytest

from firmware_protocol import _firmware
from firmware_protocol.build_firmware import PACKAGE
from firmware_protocol.codec import PROTOCOL, Codec
from firmware_protocol.protection import Prover, challenge_answer, crc8, data_id
from firmware_protocol.serial_framing import encode_frame
from firmware_protocol.status_codes import FAULTS
from tests.firmware_protocol.bench import transitions

TEXT = (Path(PACKAGE) / "README.md").read_text("utf-8")
CODEC = Codec()
ffi, lib = _firmware.ffi, _firmware.lib


def rows(heading):
    section = TEXT.split(f"\n## {heading}\n")[1].split("\n## ")[0]
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in section.splitlines() if line[:1] == "|"]
    return [row for row in cells if not set("".join(row)) <= {"-"}][1:]


def test_frames_are_those_of_the_dbc():
    documented = [(int(row[0], 16), row[1].strip("`"), row[2].upper()) for row in rows("Frames")]
    assert documented == [(message.can_id, message.name, message.sender) for message in PROTOCOL.messages]


def test_states_are_those_of_the_c_table():
    assert [(tuple(row[0].split(", ")), row[1], row[2]) for row in rows("States")] == transitions()


def test_faults_are_those_of_the_table():
    documented = [tuple(row) for row in rows("Faults")]
    assert documented == [
        (f"`{fault.name}`", f"0x{fault.code:04X}", "yes" if fault.latches else "no", fault.hint, fault.ending)
        for fault in FAULTS.values()
    ]


ANSWER = challenge_answer(0xBEEF, 7, 0x12345678)
VALIDITY = {"left_valid": 1, "right_valid": 1, "driver_enabled": 0, "limited": 0}
SPEED = {"left_speed": 1.234, "right_speed": -2.2, "sample_time": 6000}
COMMAND = {"mode": "SPEED", "left_speed": 1.5, "right_speed": -0.75, "valid_for": 0.1, "session": 7}
HOST_STATE = CODEC.encode("HOST_STATE", 5, request="ARM", session=7, challenge_answer=ANSWER, host_fault=0)
PROVER = Prover(bytes(range(16)), CODEC)
PROVER.challenge(int.from_bytes(bytes(range(0xA0, 0xA6)), "little"))
VECTORS = {
    "WHEEL_SPEED, counter 0, major 1": CODEC.encode("WHEEL_SPEED", 0, **VALIDITY, **SPEED).data,
    "WHEEL_COMMAND, counter 3": CODEC.encode("WHEEL_COMMAND", 3, **COMMAND).data,
    "HELLO_REQUEST, counter 0": CODEC.encode(
        "HELLO_REQUEST", 0, protocol_major=1, protocol_minor=0, dbc_hash=0x12345678
    ).data,
    "HOST_STATE, counter 5": HOST_STATE.data,
    "HOST_STATE_MAC of that HOST_STATE": PROVER.prove(HOST_STATE).data,
    "serial, id 0x010, data 02 01 02 03 00": encode_frame(0x010, bytes.fromhex("0201020300")),
}


def documented(label):
    return bytes.fromhex(re.search(rf"^{re.escape(label)}\s\s+([0-9A-F ]+)$", TEXT, re.MULTILINE).group(1))


@pytest.mark.parametrize("label", VECTORS)
def test_vectors(label):
    assert documented(label) == VECTORS[label]


@pytest.mark.parametrize(
    "label", ["data id 0x0110 (no major version), counter 0", "the same, counter 1", "the same, counter 15"]
)
def test_vectors_without_major(label):
    data = documented(label)
    assert data[0] == crc8(data[1:], data_id(0x110, 0)) == lib.disco_e2e_crc(data, 0x0110)


def test_linked_files_exist():
    for target in re.findall(r"\]\(([^)]+)\)", TEXT):
        assert (Path(PACKAGE) / target).exists(), target
