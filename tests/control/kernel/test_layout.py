"""Buffers: on a cache line, of the size asked for; blocks that hold all samples."""

import re
from pathlib import Path

import numpy as np
import pytest

from disco_hw.control import kernel as layout
from disco_hw.control.kernel import BLOCK, aligned_zeros, block_count


@pytest.mark.parametrize(("size", "dtype"), [(1, np.float32), (80, np.float32), (33, np.float64), (7, np.int64)])
def test_buffers_begin_on_a_cache_line_and_are_zero(size, dtype):
    # Several, kept, so that the allocator cannot give every one the same lucky place.
    for buffer in [aligned_zeros(size, dtype) for _ in range(8)]:
        assert buffer.ctypes.data % 64 == 0
        assert (buffer.shape, buffer.dtype) == ((size,), np.dtype(dtype))
        assert not buffer.any()
        buffer[:] = 1


@pytest.mark.parametrize(("samples", "blocks"), [(1, 1), (79, 1), (80, 1), (81, 2), (400, 5), (25_600, 320)])
def test_the_last_block_may_be_partly_idle(samples, blocks):
    assert block_count(samples) == blocks
    assert blocks * int(BLOCK) >= samples > (blocks - 1) * int(BLOCK)


def test_the_document_draws_the_rows_as_they_are():
    text = (Path(__file__).parents[3] / "docs/kernel.md").read_text("utf-8")
    assert f"BLOCK = {layout.BLOCK} samples, {4 * layout.BLOCK} bytes" in text
    assert f"{layout.STATE_ROWS} rows. A point" in text
    (shared, own) = re.findall(r"^row +\d+ (?:axle|x) .*$", text, re.MULTILINE)
    rows = {
        name: int(number) for number, name in re.findall(r"(\d+) ([a-z]+(?: [a-z]+)?)", shared.replace("shared", ""))
    }
    drawn = {"axle x": layout.AXLE_X, "axle y": layout.AXLE_Y, "cos yaw": layout.COS, "sin yaw": layout.SIN}
    drawn["forward speed"] = layout.FORWARD
    assert {name: int(at // layout.BLOCK) for name, at in drawn.items()} == rows
    rows = {name: int(number) for number, name in re.findall(r"(\d+) ([a-z]+)\b", own)}
    drawn = {"x": layout.X, "y": layout.Y, "memory": layout.MEMORY, "cost": layout.TOTAL, "kept": layout.KEPT}
    drawn |= {"row": layout.ROW}
    assert {name: int((layout.POINT + at) // layout.BLOCK) for name, at in drawn.items()}.items() <= rows.items()
    assert f"{int((layout.POINT + layout.FOUND) // layout.BLOCK)}..14 found" in own
    others = [layout.AHEAD0, layout.AHEAD1, layout.SCALED0, layout.SCALED1]
    begins = [int(number) for number in re.findall(r"^row +(\d+) \.\.", text, re.MULTILINE)]
    assert [int(at // layout.BLOCK) for at in others] == begins
    # The four numbers found of every sample end where the next point's rows begin.
    assert layout.FOUND + layout.COLUMNS * layout.BLOCK == layout.AHEAD0 - layout.POINT
    assert begins[-1] + 10 == layout.STATE_ROWS


def test_every_part_of_the_kernel_is_in_the_document():
    folder = Path(layout.__file__).parent
    text = (Path(__file__).parents[3] / "docs/kernel.md").read_text("utf-8")
    files = {path.name for path in folder.glob("*.py")} - {"__init__.py", "step.py"}
    assert {name for name in files if f"`{name}`" not in text} == set()
