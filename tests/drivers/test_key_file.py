import os

import pytest

from drivers.key_file import KeyFileError, key_of_file

DIGITS = "000102030405060708090a0b0c0d0e0f"


def read_key_file(path):
    return key_of_file(path, path.read_bytes(), path.stat())


def write(path, text=DIGITS + "\n", mode=0o600):
    path.write_text(text)
    path.chmod(mode)
    return path


@pytest.mark.parametrize("mode", [0o600, 0o400])
def test_a_key_that_its_owner_alone_can_read(tmp_path, mode):
    assert read_key_file(write(tmp_path / "key", mode=mode)) == bytes(range(16))


@pytest.mark.parametrize("mode", [0o640, 0o604, 0o660, 0o644, 0o610, 0o601, 0o777])
def test_a_key_open_to_others_is_refused(tmp_path, mode):
    path = write(tmp_path / "key", mode=mode)
    with pytest.raises(KeyFileError, match=rf"mode {mode:04o}.*chmod 600 {path}"):
        read_key_file(path)


@pytest.mark.parametrize("text", ["", "secret", DIGITS[:-1], DIGITS + "0", "é" * 32, DIGITS + "\n" + DIGITS])
def test_what_is_no_key_is_refused_without_being_shown(tmp_path, text):
    path = write(tmp_path / "key", text)
    with pytest.raises(KeyFileError, match="is no key of 32 hexadecimal digits; make one with") as error:
        read_key_file(path)
    assert "secret" not in str(error.value)
    assert "\n" not in str(error.value)


def test_the_key_of_another_user_is_refused(tmp_path, monkeypatch):
    path = write(tmp_path / "key")
    other = os.geteuid() + 1
    if os.geteuid() == 0:
        os.chown(path, other, -1)
    else:
        monkeypatch.setattr(os, "geteuid", lambda: other)
    with pytest.raises(KeyFileError, match="belongs to another user"):
        read_key_file(path)
