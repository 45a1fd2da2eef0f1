"""The example of docs/control.md, as it stands there."""

import re
from pathlib import Path

DOCUMENT = Path(__file__).parents[2] / "docs/control.md"


def test_the_example_is_short_and_reaches_its_goal(capsys):
    (example,) = re.findall(r"```python\n(.*?)```", DOCUMENT.read_text("utf-8"), re.DOTALL)
    assert len([line for line in example.splitlines() if line.strip()]) < 40
    scope = {"__name__": "example"}
    exec(compile(example, str(DOCUMENT), "exec"), scope)
    assert abs(scope["position"] - 1.0) < 0.05
    assert abs(scope["speed"]) < 0.1
    assert capsys.readouterr().out.startswith("at ")


def test_the_document_begins_with_the_oracle():
    text = DOCUMENT.read_text("utf-8")
    assert "oracle.py" in text.splitlines()[2]
    assert text.index("oracle.py") < text.index("disco_hw.control.Disco")
