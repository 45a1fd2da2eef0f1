"""What is known of an effect stands in its file: nowhere else in the package is one named."""

import re
from pathlib import Path

import disco_hw
from disco_hw.effects.registry import REGISTRY


def test_no_other_file_names_an_effect():
    package = Path(disco_hw.__file__).parent
    sources = {path: path.read_text(encoding="utf-8") for path in package.rglob("*.py")}
    assert len(sources) > 100
    named = {
        name: [str(path.relative_to(package)) for path, text in sources.items() if elsewhere(name, path, text)]
        for name in REGISTRY
    }
    assert {name: found for name, found in named.items() if found} == {}


def elsewhere(name, path, text):
    return path.name != f"{name}.py" and re.search(rf"""["']{name}["'.]""", text) is not None


def test_an_effect_is_named_in_its_own_file():
    effects = Path(disco_hw.__file__).parent / "effects"
    for name in REGISTRY:
        assert f'name="{name}"' in (effects / f"{name}.py").read_text(encoding="utf-8")
