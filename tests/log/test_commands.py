import json

import pytest

from disco_hw.log.commands import export, info, recover
from disco_hw.log.errors import LogError
from tools.log_samples import drive_ticks, log_bytes, write_log


@pytest.fixture
def log(tmp_path):
    return write_log(tmp_path / "run.mcap", drive_ticks(100), flush_every=10)


@pytest.fixture
def cut(tmp_path):
    path = tmp_path / "cut.mcap"
    data = log_bytes(drive_ticks(100), flush_every=10)
    path.write_bytes(data[: len(data) * 6 // 10])
    return path


def test_info_says_what_a_log_holds(log):
    text = info(log, as_json=False)
    assert "wombot" in text
    assert "100 ticks, 0 missing; ended properly" in text
    assert "/wheels" in text
    assert "attached: robot.toml" in text
    assert "lost" not in text
    summary = json.loads(info(log, as_json=True))
    assert summary["topics"]["/wheels"]["count"] == 100
    assert summary["complete"] is True


def test_info_says_what_is_lost(cut):
    text = info(cut, as_json=False)
    assert "not ended properly" in text
    assert "lost: at byte" in text
    assert json.loads(info(cut, as_json=True))["damage"]


def test_recover_says_what_came_over_and_what_not(cut, log, tmp_path):
    text = recover(cut, tmp_path / "a.mcap", as_json=False)
    assert "chunks, 2 attachments" in text
    assert "lost: " in text
    assert "lost: " in info(tmp_path / "a.mcap", as_json=False)
    plain = json.loads(recover(log, tmp_path / "b.mcap", as_json=True))
    assert plain["out"] == str(tmp_path / "b.mcap")
    assert (plain["chunks"], plain["lost"]) == (10, [])
    assert "nothing was lost" in recover(log, tmp_path / "c.mcap", as_json=False)


def test_export_writes_the_csv(log, tmp_path):
    text = export(log, tmp_path / "a.csv", as_json=False)
    header = (tmp_path / "a.csv").read_text(encoding="utf-8").splitlines()[0]
    assert "rows, 1 segments" in text
    assert header.startswith("t_s,cmd_left_rad_s,cmd_right_rad_s,enc_left_ticks,enc_right_ticks,enc_left_rad_s")
    plain = json.loads(export(log, tmp_path / "b.csv", as_json=True))
    assert plain["rows"] == len((tmp_path / "b.csv").read_text(encoding="utf-8").splitlines()) - 1


@pytest.mark.parametrize("command", [lambda path: info(path, False), lambda path: export(path, path, False)])
def test_what_is_no_log_is_refused(tmp_path, command):
    path = tmp_path / "x"
    path.write_bytes(b"nothing of ours")
    with pytest.raises(LogError, match="not an MCAP file"):
        command(path)
