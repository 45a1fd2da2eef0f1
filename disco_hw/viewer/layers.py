"""Checkboxes that show and hide the layers of a scene."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import viser

from disco_hw.viewer.scene import LAYERS, Scene


def add_layers(gui: viser.GuiApi, scene: Scene, changed: Callable[[], None]) -> None:
    """One checkbox a layer; `changed` is called after each click, the next snapshot is drawn with what is ticked."""
    with gui.add_folder("Layers", expand_by_default=False):
        for name, label in LAYERS.items():
            box = gui.add_checkbox(label, scene.layers[name])

            @box.on_update
            def _(event: Any, name: str = name) -> None:
                scene.layers[name] = bool(event.target.value)
                changed()
