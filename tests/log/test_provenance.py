import re

import pytest

from disco_hw.errors import InputError
from disco_hw.files import MODEL_TOML, ROBOT_TOML
from disco_hw.log.provenance import attachment, version


def test_the_version_names_the_package_and_in_a_checkout_the_commit():
    assert re.fullmatch(r"\d+\.\d+\.\d+(\+g[0-9a-f]{7,}(-dirty)?)?", version())


def test_a_file_is_kept_as_it_is(tmp_path):
    path = tmp_path / "model.toml"
    path.write_bytes(b"\xff\x00")
    kept = attachment(path, "model.toml", MODEL_TOML)
    assert (kept.name, kept.media_type, kept.data) == ("model.toml", "application/toml", b"\xff\x00")
    assert attachment(path, "robot.toml", ROBOT_TOML).name == "robot.toml"


def test_a_file_that_cannot_be_read_is_named(tmp_path):
    with pytest.raises(InputError, match=r"none\.toml: cannot be read"):
        attachment(tmp_path / "none.toml", "none.toml", ROBOT_TOML)
