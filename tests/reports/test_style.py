"""Every report is one page that needs nothing else: its style and its pictures are in it, and text stays text."""

import base64
import re

from matplotlib.figure import Figure

from disco_hw import reports


def test_a_page_needs_no_other_file_and_a_title_is_no_markup():
    made = reports.page("a < b", reports.picture(b"\x89PNG", "x & y", "1 < 2"))
    assert "<h1>a &lt; b</h1>" in made
    assert "<figcaption>1 &lt; 2</figcaption>" in made
    assert 'alt="x &amp; y"' in made
    assert all(source.startswith("data:") for source in re.findall(r'src="([^"]*)"', made))
    assert "<link" not in made
    assert base64.b64encode(b"\x89PNG").decode() in made


def test_a_picture_without_a_caption_has_none():
    assert "figcaption" not in reports.picture(b"", "name")


def test_a_figure_is_written_as_the_png_that_a_page_would_hold(tmp_path):
    figure = Figure(figsize=(2.0, 1.0))
    figure.subplots().plot([0.0, 1.0])
    path = tmp_path / "figure.png"
    reports.write_png(figure, path)
    assert path.read_bytes() == reports.png(figure)
    assert path.read_bytes().startswith(b"\x89PNG\r\n")
