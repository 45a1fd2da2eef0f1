"""The ports compile, with the host's compiler and stubs of the vendors' declarations: no hardware has run them."""

import re
import shutil
import subprocess

import pytest

from firmware_protocol.build_firmware import PACKAGE, SOURCES
from tests.tables import thinned

FIRMWARE, PORTS = PACKAGE / "firmware", PACKAGE / "ports"
CONTRACT = (PORTS / "port.h").read_text("utf-8")
STUBS = PORTS.parents[1] / "tests" / "firmware_protocol" / "ports" / "stubs"
WARNINGS = ("-Wall", "-Wextra", "-Wdouble-promotion", "-Wstrict-prototypes", "-Werror", "-Wno-int-to-pointer-cast")
SKELETONS = ("template", "stm32", "rp2040", "esp32")
LINKS = {"esp32": ["-DDISCO_LINK_CAN"]}
"""Flags without which a skeleton must not compile: the main loop needs the same."""
AROUND_THE_BOARD = {"plant.c", "plant.h"}
START_CODE = {"mps2": 80}
"""Where no vendor's library brings vectors, start code and memory map: lines for those."""


OPTIONAL = re.search(r"^#if defined\(DISCO_PLANT_LINE\)\n(.*?)^#endif", CONTRACT, re.MULTILINE | re.DOTALL)[1]


def functions(text):
    return set(re.findall(r"^[\w ]+[ *](port_\w+)\(", text, re.MULTILINE))


REQUIRED = functions(CONTRACT.replace(OPTIONAL, ""))


def compile_c(*arguments, options=()):
    command = ["cc", "-std=c11", *WARNINGS, *options, f"-I{FIRMWARE}", f"-I{PORTS}", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def compiled(*arguments, options=()):
    ran = compile_c(*arguments, options=options)
    assert ran.returncode == 0, ran.stderr


def test_the_contract_has_at_most_a_dozen_functions_and_each_is_explained():
    assert 10 <= len(REQUIRED) <= 12
    assert functions(OPTIONAL) == {"port_plant_receive", "port_plant_send"}
    for name in functions(CONTRACT):
        before = CONTRACT[: CONTRACT.index(f"{name}(")].rstrip().rsplit("\n", 2)
        assert any("*/" in line or "port_" in line for line in before), name


@pytest.mark.parametrize("port", [*SKELETONS, "mps2"])
def test_a_port_is_the_contract_in_at_most_300_lines(port):
    text = (PORTS / port / "port.c").read_text("utf-8")
    # A firmware with a plant's line belongs to a board on a desk: who wants one adds the pair himself.
    assert REQUIRED <= functions(text) <= (REQUIRED if port in SKELETONS else functions(CONTRACT))
    port_files = [file for file in (PORTS / port).iterdir() if file.name not in AROUND_THE_BOARD]
    assert sum(len(file.read_text("utf-8").splitlines()) for file in port_files) <= 300 + START_CODE.get(port, 0)
    if port in ("stm32", "rp2040", "esp32"):
        assert "NOT RUN ON HARDWARE" in " ".join(text.split()).replace(" * ", " ")


@pytest.mark.parametrize(
    ("port", "link"),
    [*((port, LINKS.get(port, [])) for port in SKELETONS), ("template", ["-DDISCO_LINK_CAN"])],
    ids=[*SKELETONS, "can"],
)
def test_a_skeleton_compiles_against_what_its_vendor_declares(port, link, tmp_path):
    include = [f"-I{STUBS / port}", f"-I{PORTS / port}"]
    compiled("-c", PORTS / port / "port.c", "-o", tmp_path / "port.o", options=[*include, *link])


def test_a_skeleton_for_a_bus_does_not_compile_for_the_serial_line_that_the_main_loop_would_take(tmp_path):
    """The two would exchange a frame and bytes in one another's memory."""
    tried = compile_c("-c", PORTS / "esp32" / "port.c", "-o", tmp_path / "port.o", options=[f"-I{STUBS / 'esp32'}"])
    assert tried.returncode != 0
    assert "port_receive" in tried.stderr


@pytest.mark.parametrize(
    ("options", "absent"),
    [
        (["-DDISCO_PLANT_LINE"], ("port_measure", "port_drive")),
        *((link, ("plant",)) for link in ([], ["-DDISCO_LINK_SLCAN"], ["-DDISCO_LINK_CAN"])),
    ],
    ids=["plant's line", "serial", "slcan", "can"],
)
def test_the_main_loop_with_a_plants_line_never_measures_or_drives(options, absent, tmp_path):
    """... so that its motors cannot turn, whatever a virtual robot says; and without one it knows nothing of it."""
    compiled("-c", PORTS / "controller.c", "-o", tmp_path / "controller.o", options=options)
    listed = subprocess.run(["nm", str(tmp_path / "controller.o")], capture_output=True, text=True, check=True).stdout
    assert "port_feed_watchdog" in listed
    assert not [name for name in absent if name in listed]


@thinned("optimisation", ["-O0", "-Os"], quick=1)
def test_the_guides_commands_make_a_whole_firmware_of_the_template(optimisation, tmp_path):
    """As they stand where there is a cross-compiler, else with this computer's; a warning is an error here."""
    guide = (PACKAGE.parent / "docs" / "port.md").read_text("utf-8")
    (commands,) = re.findall(r"```sh\n(LINK=.*?)```", guide, re.DOTALL)
    if shutil.which("arm-none-eabi-gcc") is None:
        commands = re.sub(r"^CC=.*", "CC=cc", commands, flags=re.MULTILINE)
    (tmp_path / "firmware_protocol").symlink_to(PACKAGE)
    commands = commands.replace("-Wall", "-Wall -Werror").replace("-Os", optimisation)
    ran = subprocess.run(["sh", "-ec", commands], cwd=tmp_path, capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr
    assert (tmp_path / "my_board.elf").exists()


def test_nothing_between_an_interrupt_and_the_main_loop_is_lost_or_torn(tmp_path):
    program = tmp_path / "queue"
    compiled(STUBS.parent / "queue_threads.c", "-pthread", "-O2", "-o", program)
    ran = subprocess.run([str(program)], capture_output=True, text=True, timeout=120, check=False)
    assert (ran.returncode, ran.stdout) == (0, "0 wrong, 0 left\n")


def test_the_threads_of_the_queue_do_not_race(tmp_path):
    program, probe = tmp_path / "queue", tmp_path / "probe.c"
    probe.write_text("int main(void) { return 0; }\n")
    sanitizer = ["-fsanitize=thread", "-O1", "-g", "-pthread"]
    if subprocess.run(["cc", *sanitizer, str(probe), "-o", str(program)], capture_output=True, check=False).returncode:
        pytest.skip("this compiler has no thread sanitizer")
    if subprocess.run([str(program)], capture_output=True, check=False).returncode:
        pytest.skip("the thread sanitizer does not run here")
    compiled(STUBS.parent / "queue_threads.c", *sanitizer, "-o", program)
    ran = subprocess.run([str(program)], capture_output=True, text=True, timeout=200, check=False)
    assert ran.returncode == 0, ran.stderr


def test_the_core_has_no_double():
    """The cross-compiler says so, too: tools/check/emulated_board.py has it take -Wdouble-promotion for an error."""
    for name in SOURCES:
        if name == "disco_robot.c":
            continue  # its doubles are in functions that nothing calls
        text = re.sub(r"/\*.*?\*/", "", (FIRMWARE / name).read_text("utf-8"), flags=re.DOTALL)
        assert not re.search(r"\bdouble\b|\b(floor|fabs|fmax|fmin|sqrt|round|lround)\(", text), name
        assert not re.search(r"(?<![\w.])\d+\.\d+(e[+-]?\d+)?(?![\dfe.])", text), name
