import re
import sys

import pytest

from firmware_protocol.codec import packaged_dbc
from tools.generate import protocol as generate_protocol
from tools.generate.protocol import FIRMWARE, generated_files, load_protocol, main


def test_committed_files_are_current():
    for name, text in generated_files(packaged_dbc()).items():
        assert (FIRMWARE / name).read_text("utf-8") == text, f"{name}: run python -m tools.generate.protocol"


def test_generated_files_do_not_depend_on_the_day_or_on_the_tools_version():
    for text in generated_files(packaged_dbc()).values():
        assert "version" not in text.split("*/", 1)[0]


def test_every_file_is_written(tmp_path, monkeypatch):
    monkeypatch.setattr(generate_protocol, "FIRMWARE", tmp_path)
    monkeypatch.setattr(sys, "argv", ["generate_protocol"])
    assert main() == 0
    assert {path.name: path.read_text("utf-8") for path in tmp_path.iterdir()} == generated_files(packaged_dbc())


def test_constants_say_what_the_dbc_says():
    constants = generated_files(packaged_dbc())["protocol_constants.h"]
    protocol = load_protocol(packaged_dbc())
    assert f"#define DISCO_DBC_HASH (0x{protocol.dbc_hash:08X}u)\n" in constants
    assert "#define DISCO_WHEEL_COMMAND_LEFT_SPEED_PER_UNIT (500) /* rad/s */\n" in constants
    assert "#define DISCO_STATE_ARMED (3u)\n" in constants
    assert "#define DISCO_DATA_ID(can_id, major) ((uint16_t)((can_id) ^ ((uint32_t)(major) << 11)))\n" in constants
    made = re.findall(r"#define DISCO_(\w+)_DATA_ID\(major\) DISCO_DATA_ID\((0x\w+)u, (0u|major)\)\n", constants)
    ids = {name: int(can_id, 16) ^ (protocol.major if major == "major" else 0) << 11 for name, can_id, major in made}
    assert ids == {message.name: message.data_id for message in protocol.messages if message.data_id is not None}
    assert ids["HELLO"] == 0x140


def test_two_tables_under_one_name_are_refused():
    changed = packaged_dbc().replace('VAL_ 353 key 1 "OVER_CURRENT"', 'VAL_ 353 key 1 "OTHER"')
    with pytest.raises(ValueError, match="signal key has two different value tables"):
        generated_files(changed)
