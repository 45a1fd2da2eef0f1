"""The main loop with the core, replayed under the sanitizers without a clock: whatever bytes come, it stays sound."""

import itertools
import random
import re
import struct
import subprocess
from functools import cache
from pathlib import Path

import pytest

from firmware_protocol.build_firmware import PACKAGE
from firmware_protocol.codec import Codec
from firmware_protocol.serial_framing import FrameDecoder, encode_frame
from tests.firmware_protocol.ports.posix_board import TEMPLATE
from tests.tables import thinned

PORTS = PACKAGE / "ports"
PORT = Path(__file__).with_name("replay_port.c")
CODEC = Codec()
LINE_US, USB_US = 11, 1
"""Between bytes: of a serial line at 921600 Bd, and of USB."""
HOST_IDS = (0x080, 0x0F0, 0x0F1, 0x0F2, 0x100, 0x101, 0x102, 0x150, 0x160)
PLANT_IDS = (0x7E0, 0x7E1, 0x7E2, 0x7E3)


def wire_text(can_id, data):
    return f"t{can_id:03X}{len(data)}{data.hex()}\r".encode()


def record(can_id, data):
    return struct.pack("<HB8s", can_id, len(data), data)


LINKS = {
    "serial": ((), encode_frame),
    "slcan": (("-DDISCO_LINK_SLCAN",), wire_text),
    "can": (("-DDISCO_LINK_CAN",), record),
    "template": (TEMPLATE, encode_frame),
    "plant": (("-DDISCO_PLANT_LINE", str(PORTS / "plant_line.c")), encode_frame),
}


@pytest.fixture(scope="module")
def board(compiled_core, tmp_path_factory):
    """Compile the board for a kind of link."""
    flags, objects = compiled_core

    @cache
    def compiled(link):
        program = tmp_path_factory.mktemp(link) / "board"
        sources = [str(PORTS / "controller.c"), str(PORT), *LINKS[link][0]]
        command = ["cc", *flags, "-std=c11", f"-I{PORTS}", *sources, *objects, "-lm"]
        subprocess.run([*command, "-o", str(program)], check=True)
        return program

    return compiled


@pytest.fixture
def replay(board, tmp_path):
    """Let the board hear these bytes; what it said, its cycles and its stores."""

    def replayed(link, received_bytes, byte_us=LINE_US, plant=b""):
        line, plant_line = tmp_path / "line", tmp_path / "plant"
        line.write_bytes(received_bytes)
        plant_line.write_bytes(plant)
        environment = {"LINK": str(line), "PLANT": str(plant_line), "BYTE_US": str(byte_us)}
        environment["ASAN_OPTIONS"] = "detect_leaks=0"
        ran = subprocess.run([str(board(link))], capture_output=True, env=environment, check=False)
        stderr = ran.stderr.decode()
        assert ran.returncode == 0, stderr
        cycles, stores = map(int, re.fullmatch(r"(\d+) cycles (\d+) stores\n", stderr).groups())
        return ran.stdout, cycles, stores

    return replayed


def frames_of(link, output):
    if link == "slcan":
        lines = re.findall(rb"t([0-9A-F]{3})(\d)([0-9A-F]*)\r", output)
        return [(int(can_id, 16), bytes.fromhex(data.decode())) for can_id, _, data in lines]
    if link == "can":
        return [(can_id, data[:length]) for can_id, length, data in struct.iter_unpack("<HB8s", output)]
    return FrameDecoder().feed(output)


def answers(link, output, name):
    can_id = CODEC.can_id(name)
    return [CODEC.decode(can_id, data).values for seen, data in frames_of(link, output) if seen == can_id]


def garbage(draw, link, ids):
    """Frames of random data, some with a sound CRC, some damaged, cut off or of a length that no frame has; noise."""
    _, written = LINKS[link]
    for number in itertools.count():
        data = draw.randbytes(8 if draw.random() < 0.7 else draw.randint(0, 8))
        if number % 4 == 0:
            write, key, value = draw.choice(["READ", "WRITE"]), draw.randint(0, 9), draw.uniform(-9, 99)
            sound = CODEC.encode("PARAM_REQUEST", number, operation=write, key=key, value=value)
            yield written(sound.can_id, sound.data)
            continue
        piece = bytearray(written(draw.choice([*ids, draw.randrange(0x800)]), data))
        if number % 4 == 1:
            piece[draw.randrange(len(piece))] = draw.randrange(256)
        elif number % 4 == 2 and link != "can":
            piece = piece[: draw.randint(1, len(piece))] + draw.randbytes(draw.choice([0, 0, 100]))
        yield bytes(piece)


@thinned("link", LINKS, quick=2)
def test_garbage_on_its_lines_does_no_harm_and_it_answers_afterwards(replay, link):
    draw = random.Random(24)
    noise = b"".join(itertools.islice(garbage(draw, link, HOST_IDS), 4000))
    end = {"slcan": b"\rC\rO\r", "can": b""}.get(link, b"\0")
    opening = b"O\r" if link == "slcan" else b""
    request = CODEC.encode("TIME_REQUEST", 3, sequence=77)
    plant = b"".join(itertools.islice(garbage(draw, "plant", PLANT_IDS), 4000))
    output, cycles, _ = replay(link, opening + noise + end + LINKS[link][1](request.can_id, request.data), plant=plant)
    assert cycles > 2000
    assert answers(link, output, "TIME_RESPONSE")[-1]["sequence"] == 77


@thinned("link", ["serial", "slcan", "can"], quick=1)
def test_a_line_that_never_falls_silent_does_not_hold_up_the_cycle(replay, link):
    """As USB's can be: twice as fast as the core takes it in, for half a second without a gap."""
    frame = LINKS[link][1](0x7FF, bytes(8))
    received_bytes = frame * (500_000 // len(frame))
    _, cycles, _ = replay(link, received_bytes, byte_us=USB_US)
    assert cycles >= 2400


def test_parameters_are_stored_when_they_change_and_not_each_time_they_are_written(replay):
    """Flash wears out."""
    values = [5.0] * 10 + [6.0] * 10 + [5.0]
    requests = [CODEC.encode("PARAM_REQUEST", i, operation="WRITE", key=4, value=v) for i, v in enumerate(values)]
    # 20 ms of silence between them.
    received_bytes = b"".join(bytes(2000) + encode_frame(frame.can_id, frame.data) for frame in requests)
    output, _, stores = replay("serial", bytes(20_000) + received_bytes)
    assert [response["value"] for response in answers("serial", output, "PARAM_RESPONSE")] == values
    assert stores == 3


def test_a_board_whose_wheels_are_not_measured_yet_has_no_fault(replay):
    """As in steps 4 and 5 of docs/port.md: the conformance suite needs a robot in STANDBY."""
    output, _, _ = replay("template", bytes(20_000))
    states = answers("template", output, "SYSTEM_STATE")
    assert states
    assert {CODEC.choice_name("SYSTEM_STATE", "fault", state["fault"]) for state in states} == {"NONE"}
