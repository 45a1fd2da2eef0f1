"""Where a point of the world is on a screenshot of the page, before anybody moves the camera."""

import io
import math

import numpy as np
from PIL import Image

FIELD_OF_VIEW = math.radians(75.0)


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
    """What the page shows, (height, width, 3)."""
    return np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB")).astype(int)


def like(colour, wanted, least=4):
    """Whether the order of the channels is that of the wanted colour: what is drawn fades in, but grey stays grey."""
    return np.argmax(colour) == np.argmax(wanted) and np.argmin(colour) == np.argmin(wanted) and np.ptp(colour) > least


def shows(picture, column, row, wanted, reach=5):
    """Whether a pixel near a place is like the wanted colour."""
    row, column = round(row), round(column)
    part = picture[max(row - reach, 0) : row + reach + 1, max(column - reach, 0) : column + reach + 1].reshape(-1, 3)
    return any(like(pixel, wanted) for pixel in part)
