"""What uv is given of pip's settings, and that pip installs where uv cannot."""

import subprocess
import sys
from pathlib import Path

import pytest

from tools import install
from tools.install import uv_variables


def test_uv_is_given_what_pip_is():
    settings = (
        ":env:.find-links='/wheels /more'\n"
        "global.cert='/certificates.crt'\n"
        "global.extra-index-url='file:///a/simple file:///b/simple'\n"
        "global.find-links='/not/these'\n"
        "global.index-url='https://general.example/simple'\n"
        "install.index-url='https://installing.example/simple'\n"
        "wheel.proxy='http://for.another.command'\n"
        "global.timeout='60'\n"
    )
    assert uv_variables(settings) == {
        "UV_INDEX_STRATEGY": "unsafe-best-match",
        "UV_DEFAULT_INDEX": "https://installing.example/simple",
        "UV_INDEX": "file:///a/simple file:///b/simple",
        "UV_FIND_LINKS": "/wheels,/more",
        "SSL_CERT_FILE": "/certificates.crt",
        "UV_HTTP_TIMEOUT": "60",
    }


def test_what_this_pip_is_set_to_is_found(tmp_path, monkeypatch):
    """Asked as the installation asks it, of pip itself."""
    monkeypatch.setenv("PIP_FIND_LINKS", str(tmp_path))
    listed = subprocess.run([*install.PIP, "config", "list"], capture_output=True, text=True, check=True).stdout
    assert uv_variables(listed)["UV_FIND_LINKS"] == str(tmp_path)


@pytest.mark.parametrize("failing", ["uv", "pip --disable-pip-version-check install --quiet --no-compile uv"])
def test_pip_installs_where_uv_cannot(failing, monkeypatch, capsys):
    command_lines = []

    def run(command, **_settings):
        command_line = " ".join(command).removeprefix(f"{sys.executable} -m ")
        command_lines.append(command_line)
        return subprocess.CompletedProcess(
            command, int(command_line.startswith(failing) or command_line == failing), stdout=""
        )

    monkeypatch.setattr(subprocess, "run", run)
    monkeypatch.setattr(install, "find_spec", lambda _name: None)
    assert install.main(".[dev]") == 0
    assert command_lines[-1] == "pip --disable-pip-version-check install --quiet --no-compile --editable .[dev]"
    assert "pip does" in capsys.readouterr().err


def test_the_constraints_are_this_projects():
    assert Path(install.CONSTRAINTS).read_text().count("==") > 50
