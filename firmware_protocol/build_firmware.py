"""Compiles the C firmware core into the extension `firmware_protocol._firmware`; run as a script, it builds in place.

The declarations are taken from the headers themselves, so that nothing is typed twice. This file is also executed by
setuptools in an isolated environment where nothing but cffi is installed.
"""

import re
from pathlib import Path

from cffi import FFI

PACKAGE = Path(__file__).resolve().parent
SOURCES = tuple(sorted(path.name for path in (PACKAGE / "firmware").glob("*.c")))
# What Python uses, each after those that it includes; the others only the core's own modules include.
HEADERS = (
    "disco_robot.h",
    "e2e.h",
    "cmac.h",
    "authentication.h",
    "wheel_limits.h",
    "robot_config.h",
    "states.h",
    "faults.h",
    "transmit.h",
    "serial_framing.h",
    "slcan.h",
    "parameter_record.h",
    "core.h",
    "pose.h",
    "firmware.h",
)
_WRAPPER = re.compile(r"^(#.*|extern \"C\" \{|\})$", re.MULTILINE)
_COMMENT = re.compile(r"/\*.*?\*/", re.DOTALL)


def declarations(header: str) -> str:
    """Return a header's declarations without comments, preprocessor lines and the C++ wrapper."""
    return _WRAPPER.sub("", _COMMENT.sub("", header.replace("\\\n", " ")))


def create_ffi() -> FFI:
    """Return the extension's definition; paths are relative to the project's root, as setuptools wants them."""
    builder = FFI()
    for header in HEADERS:
        builder.cdef(declarations((PACKAGE / "firmware" / header).read_text("utf-8")))
    builder.set_source(
        "firmware_protocol._firmware",
        "\n".join(f'#include "{header}"' for header in HEADERS),
        sources=[f"firmware_protocol/firmware/{source}" for source in SOURCES],
        include_dirs=["firmware_protocol/firmware"],
        depends=[f"firmware_protocol/firmware/{path.name}" for path in (PACKAGE / "firmware").glob("*.h")],
        extra_compile_args=["-std=c99"],
        # One file name however it is built, so that no stale extension can shadow a fresh one.
        py_limited_api=True,
    )
    return builder


ffi = create_ffi()

if __name__ == "__main__":
    ffi.compile(tmpdir=str(PACKAGE.parent), verbose=True)
