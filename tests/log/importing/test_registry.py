"""The formats that can be imported, and a new one made as docs/add-a-log-format.md says."""

from pathlib import Path

import numpy as np
import pytest

import disco_hw.log.importing
from disco_hw.errors import LogError
from disco_hw.log.importing import format_of, import_log, log_formats
from disco_hw.log.load import load_drive

EXAMPLE = Path(__file__).parents[3] / "docs/examples/wheel_text.py"


@pytest.fixture
def page_format(tmp_path, monkeypatch):
    """The page's file in the package of the formats."""
    package = tmp_path / "formats"
    package.mkdir()
    (package / "wheel_text.py").write_text(EXAMPLE.read_text(encoding="utf-8"))
    monkeypatch.setattr(disco_hw.log.importing, "__path__", [*disco_hw.log.importing.__path__, str(package)])
    log_formats.cache_clear()
    yield
    log_formats.cache_clear()


def test_formats_are_distinguished_by_their_first_bytes():
    assert format_of(b"(1700000000.1) can0 110#01").name == "candump"
    assert format_of(b"t_s,cmd_left_rad_s").name == "csv"
    assert log_formats()[-1].name == "csv"


def test_the_format_of_the_page_is_imported(page_format, robot, tmp_path):
    source = tmp_path / "wheels.txt"
    source.write_text("WHEELS\n" + "".join(f"{0.02 * k:.2f} {0.1 * k:.1f} 1.0\n" for k in range(50)))
    import_log(source, robot, tmp_path / "log.mcap")
    wheels = load_drive(tmp_path / "log.mcap").wheels
    assert wheels.t_s.size == 50
    np.testing.assert_allclose(wheels.left_speed_rad_s, 0.1 * np.arange(50), atol=1e-6)
    np.testing.assert_allclose(wheels.right_angle_rad[-1] - wheels.right_angle_rad[0], 0.98, atol=1e-6)


def test_its_faults_name_the_line(page_format, robot, tmp_path):
    source = tmp_path / "wheels.txt"
    source.write_text("WHEELS\n0.0 1.0 1.0\n0.1 fast 1.0\n")
    with pytest.raises(LogError, match=r"wheels.txt: line 3: not three numbers"):
        import_log(source, robot, tmp_path / "log.mcap")
