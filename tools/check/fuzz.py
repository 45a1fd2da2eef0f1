"""`make fuzz`: a long campaign of hostile files against every verb that reads one.

Each verb gets files made from good ones by cutting, flipping, doubling and splicing, and with what parsers stumble
over. It may read them or refuse them with one line; anything else is printed with the file kept. The verbs run in
forked processes up to where their work begins, each call for 10 s and 1 GB of memory at most.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import json
import os
import random
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

from tools.check import verb_calls

CALL_S = 10
CALL_MB = 1000.0
BATCH = 50
REPLY_TIMEOUT_S = 60.0
TOKENS = (b"nan", b"inf", b"-1", b"1e999", b"0x", b"[[", b"]]", b"\x00", b"\xff", b'"', b"\n", b",", b"=", b"9" * 400)


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


def attack(count: int, seed: int, directory: Path) -> list[str]:
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
    print(f"{number} files, " + ", ".join(f"{share} {end}" for end, share in sorted(ends.items())))
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


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tools.check.fuzz", description=__doc__)
    parser.add_argument("--seed", type=int, default=time.monotonic_ns() % 1_000_000)
    parser.add_argument("--files", type=int, default=10_000, help="how many")
    given = parser.parse_args()
    print(f"seed {given.seed}")
    with tempfile.TemporaryDirectory() as name:
        wrong = attack(given.files, given.seed, Path(name) / "files")
    print("\n".join(wrong) or "no crash, no hang")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
