import os
from pathlib import Path

import pytest

from drivers.private_files import KeyFileError, key_of_file, placed_by, user_name, why_not_private

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
    with pytest.raises(KeyFileError, match="is not a key of 32 hexadecimal digits; make one with") as error:
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


ME = os.geteuid()


def test_a_directory_is_private_to_its_owner_who_is_named_to_others(tmp_path):
    tmp_path.chmod(0o755)
    assert why_not_private(tmp_path, {ME}) is None
    assert why_not_private(tmp_path, {ME + 1}) == f"belongs to {user_name(ME)}"
    assert user_name(0) == "root (0)"
    assert user_name(4_000_000) == "user 4000000"


@pytest.mark.parametrize("mode", [0o775, 0o757, 0o1777])
def test_what_others_can_write_to_is_not_private(tmp_path, mode):
    tmp_path.chmod(mode)
    assert "others can write" in why_not_private(tmp_path, {ME})


def test_a_link_is_not_followed(tmp_path):
    (tmp_path / "real").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "real")
    assert "a link" in why_not_private(tmp_path / "link", {ME})


def test_a_directory_below_one_that_others_can_write_to_can_have_been_put_there(tmp_path):
    middle = tmp_path / "middle"
    inner = middle / "inner"
    inner.mkdir(parents=True, mode=0o700)
    middle.chmod(0o777)
    assert not placed_by(inner, {ME, 0})
    assert not placed_by(Path("/tmp/any"), {ME, 0})
    assert placed_by(Path("/usr/lib/any"), {0})
