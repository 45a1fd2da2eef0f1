"""`make venv`: installs a project into this interpreter's environment, by uv where that can be had, else by pip.

uv takes half of pip's processor time and uses every core, but reads none of pip's settings: it is handed the
package indexes, the folders of wheels and the certificates that pip is configured with. Only the standard library is
imported, as nothing else is there yet.
"""

from __future__ import annotations

import ast
import os
import subprocess
import sys
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path

CONSTRAINTS = str(Path(__file__).parents[1] / "constraints.txt")
PIP = (sys.executable, "-m", "pip", "--disable-pip-version-check")
# pip's name of a setting, uv's variable for it, and what stands between values where there are several.
UV_SETTINGS = (
    ("index-url", "UV_DEFAULT_INDEX", " "),
    ("extra-index-url", "UV_INDEX", " "),
    ("find-links", "UV_FIND_LINKS", ","),
    ("cert", "SSL_CERT_FILE", " "),
    ("proxy", "ALL_PROXY", " "),
    ("default-timeout", "UV_HTTP_TIMEOUT", " "),
    ("timeout", "UV_HTTP_TIMEOUT", " "),
)


def uv_variables(pip_settings: str) -> dict[str, str]:
    """Environment variables of uv that say the same as the lines of `pip config list`.

    A setting of the environment (`:env:.`) comes before one for a command (`install.`), and that before a general one.
    """
    found: dict[str, tuple[int, str]] = {}
    order = (":env:", "install", "global")
    for line in pip_settings.splitlines():
        place, _, rest = line.partition(".")
        name, _, value = rest.partition("=")
        if place in order and value:
            rank = order.index(place)
            if name not in found or rank < found[name][0]:
                found[name] = rank, str(ast.literal_eval(value))
    variables = {uv: between.join(found[pip][1].split()) for pip, uv, between in UV_SETTINGS if pip in found}
    # As pip does: the best version of all indexes, not of the first that has any.
    return {"UV_INDEX_STRATEGY": "unsafe-best-match", **variables}


def install_with_uv(project: str, environment: Mapping[str, str]) -> bool:
    """Whether uv could be had, and installed the project; its own words of a failure go to standard error."""
    if find_spec("uv") is None:
        constrained = {**environment, "PIP_CONSTRAINT": CONSTRAINTS}
        command = [*PIP, "install", "--quiet", "--no-compile", "uv"]
        if subprocess.run(command, env=constrained, check=False).returncode:
            return False
    settings = subprocess.run([*PIP, "config", "list"], capture_output=True, text=True, check=True).stdout
    # The project itself is built anew whenever it is asked for: its C sources may have changed.
    options = ["--python", sys.executable, "--constraint", CONSTRAINTS, "--reinstall-package", "disco-hw"]
    command = [sys.executable, "-m", "uv", "--quiet", "pip", "install", *options, "--editable", project]
    return subprocess.run(command, env={**uv_variables(settings), **environment}, check=False).returncode == 0


def main(project: str) -> int:
    environment = {**os.environ, "PIP_CONSTRAINT": CONSTRAINTS}
    if install_with_uv(project, os.environ):
        return 0
    print("uv could not install it; pip does, which takes longer", file=sys.stderr)
    # Without --no-compile half of the time goes into compiling twelve thousand files, of which few are ever imported.
    command = [*PIP, "install", "--quiet", "--no-compile", "--editable", project]
    return subprocess.run(command, env=environment, check=False).returncode


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
