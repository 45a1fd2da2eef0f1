"""`make fuzz`: a long campaign of hostile files against everything that reads one; memory must not grow.

Each reader gets files made from good ones by cutting, flipping, doubling and splicing, and with what
parsers stumble over. It may read them or refuse them with one line; anything else is printed with the file kept.
"""

from __future__ import annotations

import argparse
import random
import resource
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from pathlib import Path

import disco_hw
from disco_hw.config import load_robot_config
from disco_hw.config.input_file import FAULTS_TOML, read_toml
from disco_hw.errors import InputError, WorkError
from disco_hw.log.csv_import import read_csv
from disco_hw.log.mcap_drive import drive_from_log
from disco_hw.log.reader import open_log
from disco_hw.log.recovery import recover
from disco_hw.model import load_model
from sim.fault_schedule import FaultFileError, schedule_of

GROWTH_LIMIT_MB = 30.0
WARM_UP = 300
SLOWEST_S = 5.0
ROBOTS = Path(disco_hw.__file__).parent / "robots"
CSV = "t_s,cmd_left_rad_s,cmd_right_rad_s,enc_left_rad_s,enc_right_rad_s,pose_x_m,pose_y_m,pose_yaw_rad,segment\n"
FAULTS = 'seed = 3\n[[fault]]\nkind = "drop"\nat_s = 1\nfor_s = 2.5\nto = "host"\nid = 0x100\nprobability = 0.5\n'
TOKENS = (b"nan", b"inf", b"-1", b"1e999", b"0x", b"[[", b"]]", b"\x00", b"\xff", b'"', b"\n", b",", b"=", b"9" * 400)


def _read_log(path: Path) -> None:
    with open_log(path) as log:
        log.summary()
        for _ in log.records():
            pass
        drive_from_log(log)
    target = path.with_suffix(".out")
    target.unlink(missing_ok=True)
    recover(path, target)


READERS: dict[str, Callable[[Path], object]] = {
    "robot.toml": load_robot_config,
    "model.toml": load_model,
    "faults.toml": lambda path: schedule_of(read_toml(path, FAULTS_TOML), str(path)),
    "drive.csv": lambda path: read_csv(path, 2048.0),
    "run.mcap": _read_log,
}


def good_files() -> dict[str, bytes]:
    """One sound file for each reader."""
    from tools.log_samples import drive_ticks, log_bytes  # noqa: PLC0415 - the samples are the tests'

    rows = "".join(f"{0.05 * k:.2f},1,1,1,1,{0.003 * k},0,0,0\n" for k in range(60))
    return {
        "robot.toml": (ROBOTS / "wombot.toml").read_bytes(),
        "model.toml": (ROBOTS / "wombot_model.toml").read_bytes(),
        "faults.toml": FAULTS.encode(),
        "drive.csv": (CSV + rows).encode(),
        "run.mcap": log_bytes(drive_ticks(40), flush_every=10),
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


def attack(seconds: float, seed: int, directory: Path, only: str | None = None) -> list[str]:
    """Read hostile files for so long; returns what went wrong, one line each."""
    goods = {name: good for name, good in good_files().items() if only in (None, name)}
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
            path.write_bytes(mutated(good, chance))
            began_s = time.monotonic()
            trouble = _trouble(name, path, refused)
            took_s = time.monotonic() - began_s
            if took_s > SLOWEST_S:
                trouble = trouble or f"took {took_s:.1f} s"
            counts[name] += 1
            if trouble:
                kept = Path(f"fuzz-{seed}-{number}-{name}")
                kept.write_bytes(path.read_bytes())
                wrong.append(f"{kept}: {trouble}")
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


def _trouble(name: str, path: Path, refused: dict[str, int]) -> str:
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
    parser = argparse.ArgumentParser(prog="python -m tools.fuzz", description=__doc__)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--seed", type=int, default=time.monotonic_ns() % 1_000_000)
    parser.add_argument("--only", choices=sorted(READERS))
    given = parser.parse_args()
    print(f"seed {given.seed}")
    with tempfile.TemporaryDirectory() as name:
        wrong = attack(given.minutes * 60.0, given.seed, Path(name), given.only)
    print("\n".join(wrong) or "no crash, no hang, no growth")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
