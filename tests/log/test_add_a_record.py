"""A new record, made as docs/add-a-record.md says in a copy of the package: written, listed, read again."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
LAST_TOPIC = '    Topic("/obstacle", Obstacle),'
PROGRAM = """
import sys
from pathlib import Path
from disco_hw.log.reader import open_log
from disco_hw.log.process_recorder import ProcessRecorder, RecordingSettings
from disco_hw.log.records import Temperature

log = Path(sys.argv[1])
recorder = ProcessRecorder(RecordingSettings(log, "page"))
for k in range(10):
    recorder.put(k * 20_000_000, [Temperature(k * 20_000_000, 40.0 + k)])
recorder.close(20.0)
with open_log(log) as found:
    assert found.summary().topics["/temperature"].count == 10
    print(found.columns("/temperature")["celsius"].tolist())
"""


def test_the_record_of_the_page_is_written_and_read(tmp_path):
    page = (ROOT / "docs" / "add-a-record.md").read_text(encoding="utf-8")
    (code,) = re.findall(r"```python\n(.*?)```", page, flags=re.S)
    shutil.copytree(ROOT / "disco_hw", tmp_path / "disco_hw", ignore=shutil.ignore_patterns("__pycache__"))
    records = tmp_path / "disco_hw" / "log" / "records.py"
    text = records.read_text(encoding="utf-8")
    for before, after in {
        "\nRecord = (\n": f"\n{code}\n\nRecord = (\n",
        "    | Obstacle\n)\n": "    | Obstacle\n    | Temperature\n)\n",
        f"{LAST_TOPIC}\n)": f'{LAST_TOPIC}\n    Topic("/temperature", Temperature),\n)',
    }.items():
        assert text.count(before) == 1, before
        text = text.replace(before, after)
    records.write_text(text, encoding="utf-8")
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, str(tmp_path / "log.mcap")],
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
        env={**os.environ, "PYTHONPATH": f"{tmp_path}{os.pathsep}{ROOT}"},
        cwd=tmp_path,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() == str([40.0 + k for k in range(10)])
