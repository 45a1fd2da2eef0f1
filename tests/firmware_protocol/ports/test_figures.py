"""The check of what the firmware costs: a tenth more is seen, and a worst step too far above the mean."""

import pytest

from tools.check.emulated_board import PROCESSORS, missing
from tools.generate import firmware_figures
from tools.generate.firmware_figures import DOCUMENT, ROWS, complaints, documented, measure, sizes, table

FIGURES = documented(DOCUMENT.read_text("utf-8"))


def changed(processor, name, value):
    return {other: figures | ({name: value} if other == processor else {}) for other, figures in FIGURES.items()}


def test_the_document_has_every_figure_of_every_processor():
    assert list(FIGURES) == ["m0plus", "m3", "m4f"]
    assert all(list(figures) == list(ROWS) for figures in FIGURES.values())
    assert table(FIGURES) in DOCUMENT.read_text("utf-8")


def test_what_the_document_says_is_within_what_was_promised():
    assert complaints(FIGURES, FIGURES) == []
    assert FIGURES["m4f"]["step_worst"] <= 10_000
    assert all(figures["ram"] <= 2 * 1024 for figures in FIGURES.values())
    assert all(figures["code"] + figures["constants"] <= 13 * 1024 for figures in FIGURES.values())


def test_a_figure_that_grew_by_more_than_a_tenth_is_told():
    ram = FIGURES["m3"]["ram"]
    assert complaints(changed("m3", "ram", ram * 11 // 10), FIGURES) == []
    (complaint,) = complaints(changed("m3", "ram", ram * 11 // 10 + 1), FIGURES)
    assert (
        complaint == f"m3: RAM of the core, bytes: {ram * 11 // 10 + 1}, and {ram} in port.md: more than a tenth more"
    )


def test_a_step_that_takes_more_than_three_times_the_mean_is_told():
    for key in ("", "key_"):
        low = FIGURES["m4f"][f"{key}step_worst"] // 3 - 1
        (complaint,) = complaints(changed("m4f", f"{key}step_mean", low), FIGURES)
        assert "three times the mean" in complaint


emulated = pytest.mark.skipif(bool(missing()), reason=missing() or "all there")


@pytest.mark.long
@emulated
@pytest.mark.parametrize("processor", PROCESSORS)
def test_what_is_measured_is_not_a_tenth_above_the_document(processor):
    assert complaints({processor: measure(processor)}, FIGURES) == []


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
