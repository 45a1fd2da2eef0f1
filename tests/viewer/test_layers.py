"""The checkboxes of the layers, as the page's server calls them back."""

from types import SimpleNamespace

import pytest

from disco_hw.viewer.recording import stage_of_robot
from disco_hw.viewer.scene import LAYERS, Scene
from disco_hw.viewer.server import serving
from disco_hw.viewer.views import add_layers, legend
from tools.viewer_run import ROBOT_FILE


class Boxes:
    """In the place of the page's controls: keeps each box and what is called when it is ticked."""

    def __init__(self, gui):
        self.boxes, self._add = {}, gui.add_checkbox
        gui.add_checkbox = self.add

    def add(self, label, value):
        box = self.boxes[label] = self._add(label, value)
        box.calls = []
        on_update = box.on_update
        box.on_update = lambda function: (box.calls.append(function), on_update(function))[1]
        return box


@pytest.fixture
def made(monkeypatch):
    with serving("test", port=0) as page:
        gui = page.server.gui
        changed = []
        boxes = Boxes(gui)
        scene = Scene(page.server, stage_of_robot(ROBOT_FILE))
        add_layers(page.server, scene, lambda: changed.append(True))
        yield scene, boxes.boxes, changed


def test_there_is_one_ticked_box_a_layer(made):
    _, boxes, _ = made
    assert list(boxes) == [*(layer.label for layer in LAYERS.values()), "Dark"]
    assert [label for label, box in boxes.items() if not box.value] == ["Dark"]


def test_the_legend_has_the_colour_of_each_layer_beside_its_name():
    for layer in LAYERS.values():
        assert f'rgb{layer.colour}"></span>{layer.label}</div>' in legend()


def test_dark_is_what_pale_lines_are_mixed_with(made):
    scene, boxes, changed = made
    before = scene.background
    for function in boxes["Dark"].calls:
        function(SimpleNamespace(target=SimpleNamespace(value=True)))
    assert max(scene.background) < min(before)
    assert changed == [True]


@pytest.mark.parametrize("layer", LAYERS)
def test_a_box_switches_its_own_layer_and_redraws(made, layer):
    scene, boxes, changed = made
    for function in boxes[LAYERS[layer].label].calls:
        function(SimpleNamespace(target=SimpleNamespace(value=False)))
    assert [name for name, shown in scene.layers.items() if not shown] == [layer]
    assert changed == [True]
