"""Another package that brings effects along: a module each, named by entry points, in a folder of its own."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs/add-an-effect.md"


def effect_of_the_page() -> str:
    """Return the example of docs/add-an-effect.md."""
    return (ROOT / "docs/examples/speed_drag.py").read_text(encoding="utf-8")


def entry_points_of_the_page() -> dict[str, str]:
    """Return the entry points that the page has a package declare for its effects."""
    named: dict[str, str] = tomllib.loads(_block("toml"))["project"]["entry-points"]["disco_hw.effects"]
    return named


def _block(language: str) -> str:
    (block,) = re.findall(rf"```{language}\n(.*?)```", PAGE.read_text(encoding="utf-8"), flags=re.DOTALL)
    return block


class OutsidePackage:
    """A package in `folder` with these modules; `python` runs a program beside it."""

    def __init__(self, folder: Path, **modules: str) -> None:
        site = folder / "site"
        info = site / "castor-1.0.dist-info"
        info.mkdir(parents=True)
        for name, text in modules.items():
            (site / f"{name}.py").write_text(text)
        named = "".join(f"{name} = {name}\n" for name in modules)
        (info / "METADATA").write_text("Metadata-Version: 2.1\nName: castor\nVersion: 1.0\n")
        (info / "entry_points.txt").write_text(f"[disco_hw.effects]\n{named}")
        self._folder = folder
        self._environment = os.environ | {
            "PYTHONPATH": os.pathsep.join([str(site), str(ROOT)]),
            "NUMBA_CACHE_DIR": str(folder / "numba"),
            "OPENBLAS_NUM_THREADS": "1",
        }

    def python(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        """A program, as after `python`."""
        return subprocess.run(
            [sys.executable, *arguments],
            env=self._environment, cwd=self._folder, capture_output=True, text=True, check=False,
        )  # fmt: skip

    def printed(self, program: str, *arguments: str) -> str:
        """Return what a program prints; it must not fail."""
        done = self.python("-c", program, *arguments)
        assert done.returncode == 0, done.stderr
        return done.stdout
