"""`make fuzz`: a long campaign of hostile files against everything that reads one; memory must not grow.

Each reader and each verb gets files made from good ones by cutting, flipping, doubling and splicing, and with what
parsers stumble over. It may read them or refuse them with one line; anything else is printed with the file kept.
Verbs run in forked processes up to where their work begins, each call for 10 s and 1 GB of memory at most.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import os
import random
import resource
import select
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path

from mcap.reader import make_reader
from mcap.writer import Writer

from disco_hw.config import load_robot_config
from disco_hw.errors import InputError, WorkError
from disco_hw.files import FAULTS_TOML, read_toml
from disco_hw.log.importing.csv_drive import read_csv
from disco_hw.log.load import drive_from_log
from disco_hw.log.log_command import recover_log
from disco_hw.log.reader import open_log
from disco_hw.model import load_model
from sim.fault_schedule import FaultFileError, schedule_of
from tools.check import verb_calls
from tools.check.verb_calls import good_files

GROWTH_LIMIT_MB = 30.0
WARM_UP = 300
SLOWEST_S = 5.0
CALL_S = 10
CALL_MB = 1000.0
BATCH = 50
REPLY_TIMEOUT_S = 60.0
TOKENS = (b"nan", b"inf", b"-1", b"1e999", b"0x", b"[[", b"]]", b"\x00", b"\xff", b'"', b"\n", b",", b"=", b"9" * 400)


def _read_log(path: Path) -> None:
    with open_log(path) as log:
        log.summary()
        for _ in log.records():
            pass
        drive_from_log(log)
    target = path.with_suffix(".out")
    target.unlink(missing_ok=True)
    recover_log(path, target)


READERS: dict[str, Callable[[Path], object]] = {
    "robot.toml": load_robot_config,
    "model.toml": load_model,
    "faults.toml": lambda path: schedule_of(read_toml(path, FAULTS_TOML), str(path)),
    "drive.csv": lambda path: read_csv(path, 2048.0),
    "run.mcap": _read_log,
}


def mutated(good: bytes, chance: random.Random) -> bytes:
    """A hostile relative of a good file."""
    data = bytearray(good)
    for _ in range(chance.choice((1, 1, 2, 5, 20))):
        at = chance.randrange(len(data) + 1)
        match chance.randrange(7):
            case 0:
                del data[at:]
            case 1 if data:
                data[at % len(data)] ^= 1 << chance.randrange(8)
            case 2:
                data[at:at] = chance.choice(TOKENS)
            case 3:
                del data[at : at + chance.choice((1, 4, 16, 200))]
            case 4:
                begin = chance.randrange(len(good))
                data[at:at] = good[begin : begin + chance.choice((1, 8, 64, 2000))]
            case 5:
                data[at : at + 8] = chance.randbytes(8)
            case 6:
                data[at : at + 8] = chance.choice((bytes(8), b"\xff" * 8, (1 << 62).to_bytes(8, "little")))
    return bytes(data)


def mutated_log(good: bytes, chance: random.Random) -> bytes:
    """A sound MCAP container in which a few messages, or a file that it carries, are hostile."""
    sink, reader = io.BytesIO(), make_reader(io.BytesIO(good))
    writer = Writer(sink)
    writer.start(profile=(header := reader.get_header()).profile, library=header.library)
    schemas: dict[int, int] = {}
    channels: dict[int, int] = {}
    for record in reader.iter_metadata():
        writer.add_metadata(record.name, record.metadata)
    for file in reader.iter_attachments():
        data = mutated(file.data, chance) if chance.random() < 0.3 else file.data
        writer.add_attachment(file.create_time, file.log_time, file.name, file.media_type, data)
    for schema, channel, message in reader.iter_messages():
        if channel.id not in channels:
            if schema is not None and schema.id not in schemas:
                schemas[schema.id] = writer.register_schema(schema.name, schema.encoding, schema.data)
            channels[channel.id] = writer.register_channel(
                channel.topic, channel.message_encoding, schemas.get(channel.schema_id, 0), channel.metadata
            )
        hit = chance.random() < 0.01
        data = mutated(message.data, chance) if hit else message.data
        log_time = chance.choice((0, 2**63, 2**64 - 1)) if chance.random() < 0.002 else message.log_time
        writer.add_message(channels[channel.id], log_time, data, message.publish_time, message.sequence)
    writer.finish()
    return sink.getvalue()


def hostile(name: str, good: bytes, chance: random.Random) -> bytes:
    """A hostile relative of a good file of that name."""
    return mutated_log(good, chance) if name.endswith(".mcap") and chance.random() < 0.5 else mutated(good, chance)


def attack_verbs(count: int, seed: int, directory: Path) -> list[str]:
    """Call verbs with so many hostile files; returns what went wrong, one line each."""
    directory.mkdir(exist_ok=True)
    ends: Counter[str] = Counter()
    wrong: list[str] = []
    with verb_calls.without_work():
        for one in verb_calls.CALLS:
            # What is imported here the processes have from the start.
            verb_calls.write_good(directory)
            verb_calls.call(one.argv(directory))
        number = 0
        while number < count:
            batch = range(number, min(number + BATCH, count))
            results = _in_a_process(lambda at, seed=seed: _attacked(at, seed, directory), batch)
            for at, result in zip(batch, results, strict=False):
                ends[result["end"]] += 1
                if result["error"]:
                    kept = Path(f"fuzz-{seed}-{at}-{result['name']}")
                    kept.write_bytes(_input(at, seed)[2])
                    wrong.append(f"{kept}: {result['call']}: {result['error']}")
            number = batch.start + len(results)
    print(f"verbs: {number} files, " + ", ".join(f"{share} {end}" for end, share in sorted(ends.items())))
    return wrong


def _input(number: int, seed: int) -> tuple[verb_calls.Call, str, bytes]:
    """The call, the name of the file to replace, and its hostile content."""
    chance = random.Random(f"{seed} {number}")
    one = chance.choice(verb_calls.CALLS)
    name = chance.choice(one.reads)
    return one, name, hostile(name, verb_calls.good_files()[name], chance)


def _attacked(number: int, seed: int, directory: Path) -> dict[str, str]:
    """Return how a call with a hostile file ended, and what was wrong about that."""
    one, name, content = _input(number, seed)
    shutil.rmtree(directory)
    directory.mkdir()
    verb_calls.write_good(directory)
    (directory / name).write_bytes(content)
    end, error = "", ""
    # The peak of this call alone.
    Path("/proc/self/clear_refs").write_text("5", encoding="ascii")
    signal.alarm(CALL_S)
    try:
        outcome = verb_calls.call(one.argv(directory))
        end = "got to their work" if outcome.code in (None, 0, 1) else "refused in one line"
        if outcome.code == 2 and len(outcome.errors.strip().splitlines()) != 1:
            error = f"not one line: {outcome.errors!r}"
    except BaseException:
        # Anything but a refusal in words is what the fuzzer is looking for, an alarm in a loop that catches all too.
        end, error = "failed", traceback.format_exc(limit=-3).replace("\n", " | ")
    finally:
        signal.alarm(0)
    peak_mb = _peak_mb()
    if peak_mb > CALL_MB:
        error = error or f"took {peak_mb:.0f} MB"
    return {"end": end, "name": name, "call": f"{one.verb} {one.arguments}", "error": error}


class TooSlowError(BaseException):
    """A call took over `CALL_S`."""


def _in_a_process(job: Callable[[int], dict[str, str]], numbers: Sequence[int]) -> list[dict[str, str]]:
    """What `job` returns for each number, made in a forked process; the last is of the one that did not come back."""
    read_end, write_end = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(read_end)
        signal.signal(signal.SIGALRM, _too_slow)
        with os.fdopen(write_end, "w", encoding="utf-8") as results:
            for number in numbers:
                print(json.dumps(job(number)), file=results, flush=True)
        os._exit(0)
    os.close(write_end)
    found: list[dict[str, str]] = []
    with os.fdopen(read_end, encoding="utf-8") as lines:
        while (
            len(found) < len(numbers)
            and select.select([lines], [], [], REPLY_TIMEOUT_S)[0]
            and (line := lines.readline())
        ):
            found.append(json.loads(line))
    with contextlib.suppress(ProcessLookupError):
        os.kill(child, signal.SIGKILL)
    _, status = os.waitpid(child, 0)
    if len(found) < len(numbers):
        error = f"no answer in {REPLY_TIMEOUT_S:g} s, or killed (wait status {status})"
        found.append({"end": "failed", "name": "input", "call": "", "error": error})
    return found


def _too_slow(*_: object) -> None:
    raise TooSlowError(f"over {CALL_S} s")


def _peak_mb() -> float:
    status = Path("/proc/self/status").read_text(encoding="ascii")
    return int(status.split("VmHWM:")[1].split()[0]) / 1000.0


def attack(seconds: float, seed: int, directory: Path, only: str | None = None) -> list[str]:
    """Read hostile files for so long; returns what went wrong, one line each."""
    goods = {name: good for name, good in good_files().items() if name in READERS and only in (None, name)}
    chance = random.Random(seed)
    wrong: list[str] = []
    counts = dict.fromkeys(goods, 0)
    refused = dict.fromkeys(goods, 0)
    before_mb: float | None = None
    end_s = time.monotonic() + seconds
    number = 0
    while time.monotonic() < end_s:
        for name, good in goods.items():
            number += 1
            path = directory / name
            path.write_bytes(hostile(name, good, chance))
            began_s = time.monotonic()
            error = _read_error(name, path, refused)
            took_s = time.monotonic() - began_s
            if took_s > SLOWEST_S:
                error = error or f"took {took_s:.1f} s"
            counts[name] += 1
            if error:
                kept = Path(f"fuzz-{seed}-{number}-{name}")
                kept.write_bytes(path.read_bytes())
                wrong.append(f"{kept}: {error}")
        if before_mb is None and number > WARM_UP:
            before_mb = _resident_mb()
    if before_mb is not None:
        growth_mb = _resident_mb() - before_mb
        print(f"resident memory grew by {growth_mb:.1f} MB")
        if growth_mb > GROWTH_LIMIT_MB:
            wrong.append(f"memory: {growth_mb:.1f} MB more after {number} files")
    for name, count in counts.items():
        print(f"{name}: {count} files, {refused[name]} refused in one line")
    return wrong


def _read_error(name: str, path: Path, refused: dict[str, int]) -> str:
    try:
        READERS[name](path)
    except (InputError, WorkError, FaultFileError) as error:
        refused[name] += 1
        return f"more than one line: {error!r}" if "\n" in str(error) else ""
    except Exception:
        # Anything but a refusal in words is what the fuzzer is looking for.
        return traceback.format_exc(limit=-3).replace("\n", " | ")
    return ""


def _resident_mb() -> float:
    pages = int(Path("/proc/self/statm").read_text(encoding="utf-8").split()[1])
    return pages * resource.getpagesize() / 1e6


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tools.check.fuzz", description=__doc__)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--seed", type=int, default=time.monotonic_ns() % 1_000_000)
    parser.add_argument("--verbs", type=int, default=5000, help="how many files for the verbs")
    parser.add_argument("--only", choices=sorted(READERS))
    given = parser.parse_args()
    print(f"seed {given.seed}")
    with tempfile.TemporaryDirectory() as name:
        wrong = attack_verbs(given.verbs, given.seed, Path(name) / "verbs") if given.only is None else []
        wrong += attack(given.minutes * 60.0, given.seed, Path(name), given.only)
    print("\n".join(wrong) or "no crash, no hang, no growth")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
