"""Where a point of the world is on a screenshot of the page, and whether a screenshot looks as one that was kept."""

import io
import math
import os
from pathlib import Path

import numpy as np
from PIL import Image

FIELD_OF_VIEW = math.radians(75.0)
GOLDEN = Path(__file__).with_name("golden")
"""Pictures that a person has looked at, a quarter as large; DISCO_HW_GOLDEN=write keeps those that are missing."""
BLOCK, MEAN_OFF, BLOCK_OFF = 4, 6.0, 50.0


def project(point, eye, look_at, width, height):
    """Column and row of a point in a canvas of that size, z up."""
    ahead = np.subtract(look_at, eye) / np.linalg.norm(np.subtract(look_at, eye))
    right = np.cross(ahead, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    up = np.cross(right, ahead)
    offset = np.subtract(point, eye)
    scale = 0.5 * height / math.tan(0.5 * FIELD_OF_VIEW) / (offset @ ahead)
    return 0.5 * width + scale * (offset @ right), 0.5 * height - scale * (offset @ up)


def screenshot(page):
    """Return a screenshot of the page, (height, width, 3)."""
    return np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB")).astype(int)


def like(colour, expected, least=4):
    """Whether the order of the channels is that of the wanted colour: what is drawn fades in, but grey stays grey."""
    return (
        np.argmax(colour) == np.argmax(expected) and np.argmin(colour) == np.argmin(expected) and np.ptp(colour) > least
    )


def shows(picture, column, row, expected, reach=5):
    """Whether a pixel near a place is like the wanted colour."""
    row, column = round(row), round(column)
    part = picture[max(row - reach, 0) : row + reach + 1, max(column - reach, 0) : column + reach + 1].reshape(-1, 3)
    return any(like(pixel, expected) for pixel in part)


def off_golden(picture, name):
    """How a picture (height, width, 3) differs from the kept one: the mean over all, and the most over one block.

    Blocks of 4 by 4 pixels are compared by their means, of 255: letters of another font are, a colour is not, alike.
    """
    height, width = (size // BLOCK for size in picture.shape[:2])
    blocks = picture[: height * BLOCK, : width * BLOCK].reshape(height, BLOCK, width, BLOCK, 3).mean(axis=(1, 3))
    path = GOLDEN / f"{name}.png"
    if os.environ.get("DISCO_HW_GOLDEN") == "write" and not path.exists():
        GOLDEN.mkdir(exist_ok=True)
        Image.fromarray(blocks.round().astype(np.uint8)).save(path, optimize=True)
    kept = np.asarray(Image.open(path).convert("RGB")).astype(float)
    if kept.shape != blocks.shape:
        return math.inf, math.inf
    off = np.abs(blocks - kept).mean(axis=2)
    coarse = off[: height // 4 * 4, : width // 4 * 4].reshape(height // 4, 4, width // 4, 4).mean(axis=(1, 3))
    return float(off.mean()), float(coarse.max())


def as_golden(picture, name):
    """Whether a picture looks as the kept one."""
    mean, most = off_golden(picture, name)
    return mean < MEAN_OFF and most < BLOCK_OFF
