"""The list of texts that a user can meet holds all of them, and nothing that is written for readers of the code."""

import tools.messages
from disco_hw.runtime import TRANSITIONS
from firmware_protocol import status_codes
from tools.messages import ROOT, SHIPPED, in_html, in_python, messages

SOURCE = '''
"""A module's own words."""
LIMIT = 3
"""Words about a constant."""

def work(path, sent=None):
    """Do the work."""
    if sent is None:
        raise InputError(f"{path}: not a file; give another, below {LIMIT:.2f} m")
    reply = {"ok": False, "error": "not armed yet"}
    option(help="how far to drive")
    print("one", "--word", "line done")
'''


def test_what_a_user_meets_is_listed_and_documentation_is_not():
    found = {(message.kind, message.text) for message in in_python(SOURCE, "disco_hw/some.py")}
    assert found == {
        ("refusal", "{path}: not a file; give another, below {LIMIT} m"),
        ("said", "not armed yet"),
        ("help", "how far to drive"),
        ("said", "line done"),
    }


def test_of_a_page_its_texts_labels_and_what_its_script_says():
    html = '<p>Press to stop</p><button title="Stop it now">Go</button>'
    html += '<script>\nanswer(`${x}: no answer yet`, "no way");</script>'
    found = [(message.line, message.text) for message in in_html(html, "page.html")]
    assert sorted(found) == [
        (1, "Go"),
        (1, "Press to stop"),
        (1, "Stop it now"),
        (2, "${x}: no answer yet"),
        (2, "no way"),
    ]


def test_every_reason_of_a_transition_and_every_remedy_of_a_fault_is_on_the_list(monkeypatch):
    monkeypatch.setattr(tools.messages, "SHIPPED", ("disco_hw/runtime", "firmware_protocol"))
    listed = messages()
    texts = {message.text for message in listed}
    assert {row.reason for row in TRANSITIONS if " " in row.reason} <= texts
    assert [text for text in texts if "release the robot's own button" in text]
    assert any(message.file == status_codes.__name__.replace(".", "/") + ".py" for message in listed)


def test_no_refusal_speaks_of_what_only_its_programmers_know():
    private = ("NoneType", "AssertionError", "object at", "TODO")
    files = [path for top in SHIPPED for path in (ROOT / top).rglob("*") if path.suffix in (".py", ".html")]
    assert len(files) > 250
    sources = {str(path.relative_to(ROOT)): path.read_text("utf-8") for path in files}
    # Only what holds such a word is worth reading as a tree. Nobody splits one between two lines.
    listed = [
        message
        for name, source in sources.items()
        if any(term in source for term in private)
        for message in (in_html if name.endswith(".html") else in_python)(source, name)
    ]
    assert not [message for message in listed if any(term in message.text for term in private)]
