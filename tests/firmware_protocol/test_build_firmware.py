import re
from graphlib import TopologicalSorter
from pathlib import Path

from firmware_protocol import build_firmware

FIRMWARE = Path(build_firmware.PACKAGE) / "firmware"


def test_declarations_are_what_is_left_of_a_header():
    header = (
        '#ifndef A\n/* gone;\n */\nextern "C" {\nint kept(void);\n#define LONG \\\n  1\n}\nstruct s {\n int a;\n};\n'
    )
    assert " ".join(build_firmware.declarations(header).split()) == "int kept(void); struct s { int a; };"


def includes(name: str) -> set[str]:
    """Modules whose headers a module's source and header include, by name without extension."""
    text = "".join(path.read_text("utf-8") for path in FIRMWARE.glob(f"{name}.[ch]"))
    return {Path(header).stem for header in re.findall(r'#include "(.*)"', text)} - {name}


def test_no_circle_of_modules_includes_itself():
    modules = {path.stem: includes(path.stem) for path in FIRMWARE.glob("*.[ch]")}
    tuple(TopologicalSorter(modules).static_order())  # raises CycleError


def test_paths_are_relative_as_setuptools_wants_them():
    _, _, _, options = build_firmware.ffi._assigned_source
    for path in (*options["sources"], *options["include_dirs"], *options["depends"]):
        assert not Path(path).is_absolute()
        assert (build_firmware.PACKAGE.parent / path).exists()
