"""The check of what the firmware costs: a tenth more is seen, and a worst step too far above the mean."""

from tools.firmware_figures import DOCUMENT, ROWS, complaints, documented, table

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
    (told,) = complaints(changed("m3", "ram", ram * 11 // 10 + 1), FIGURES)
    assert told == f"m3: RAM of the core, bytes: {ram * 11 // 10 + 1}, and {ram} in port.md: more than a tenth more"


def test_a_step_that_takes_more_than_three_times_the_mean_is_told():
    for key in ("", "key_"):
        low = FIGURES["m4f"][f"{key}step_worst"] // 3 - 1
        (told,) = complaints(changed("m4f", f"{key}step_mean", low), FIGURES)
        assert "three times the mean" in told
