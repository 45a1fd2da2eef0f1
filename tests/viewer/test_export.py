"""The exported file; what is in it is in test_commands.py, that a browser plays it in test_page.py."""

import pytest

from disco_hw.errors import InputError
from disco_hw.viewer import picture


def test_a_longer_log_gets_pictures_further_apart(recording, tmp_path, monkeypatch):
    monkeypatch.setattr(picture, "_MOST_PICTURES", 5)
    parts = []
    picture.export_html(recording, tmp_path / "run.html", parts.append)
    assert len(parts) == 6
    assert parts == sorted(parts)
    assert parts[-1] == 1.0


def test_a_place_that_cannot_be_written_is_told(recording, tmp_path):
    with pytest.raises(InputError, match="cannot be written"):
        picture.export_html(recording, tmp_path / "none" / "run.html", lambda part: None)
