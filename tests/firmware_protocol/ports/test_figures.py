"""What the firmware costs on each processor is within its limits, and the document has a row for each figure."""

from pathlib import Path

import pytest

from tools.check.emulated_board import PROCESSORS, missing
from tools.generate import firmware_figures
from tools.generate.firmware_figures import ROWS, measure, sizes

DOCUMENT = Path(__file__).parents[3] / "docs" / "port.md"
# Chosen: a tenth above what was measured (docs/port.md), for m0plus, m3, m4f.
LIMITS = {
    "code": (13_442, 13_041, 13_149),
    "constants": (884, 884, 884),
    "code_link": (15_169, 14_766, 14_869),
    "ram": (1883, 1883, 1883),
    "stack": (585, 572, 501),
    "step_mean": (8033, 4896, 2691),
    "step_worst": (14_257, 7604, 5168),
    "reception_mean": (2295, 1713, 1443),
    "reception_worst": (2818, 2370, 2043),
    "key_step_mean": (8046, 4904, 2700),
    "key_step_worst": (15_109, 10_117, 7759),
    "key_reception_mean": (8283, 6298, 6062),
    "key_reception_worst": (15_601, 12_142, 11_816),
}


def test_the_document_has_every_figure():
    rows = [line.split("|")[1].strip() for line in DOCUMENT.read_text("utf-8").splitlines() if line.startswith("|")]
    assert [row for row in rows if row in ROWS.values()] == list(ROWS.values())
    assert list(LIMITS) == list(ROWS)


emulated = pytest.mark.skipif(bool(missing()), reason=missing() or "all there")


@pytest.mark.long
@emulated
@pytest.mark.parametrize("processor", PROCESSORS)
def test_what_is_measured_is_within_its_limits(processor):
    figures = measure(processor)
    column = list(PROCESSORS).index(processor)
    limits = {name: of[column] for name, of in LIMITS.items()}
    assert {name: (value, limits[name]) for name, value in figures.items() if value > limits[name]} == {}
    assert figures["code"] + figures["constants"] <= 13 * 1024
    for key in ("", "key_"):
        assert figures[f"{key}step_worst"] <= 3 * figures[f"{key}step_mean"]


@pytest.mark.long
@emulated
@pytest.mark.parametrize("operation", ["(uint32_t)(core->now_us / 1000u)", "(uint32_t)((double)core->now_us * 0.5)"])
def test_a_core_that_divides_64_bits_or_has_doubles_is_not_measured(operation, tmp_path, monkeypatch):
    for source in firmware_figures.FIRMWARE.iterdir():
        (tmp_path / source.name).write_bytes(source.read_bytes())
    step = tmp_path / "firmware.c"
    text = step.read_text("utf-8")
    step.write_text(text.replace("disco_supervise(core);", f"core->reject_reason += {operation};", 1), "utf-8")
    assert step.read_text("utf-8") != text
    monkeypatch.setattr(firmware_figures, "FIRMWARE", tmp_path)
    with pytest.raises(AssertionError, match="doubles or divides 64 bits"):
        sizes("m3", tmp_path, firmware_figures.ROOTS)
