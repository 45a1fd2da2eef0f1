"""The files of the robot that a log was recorded with: into the log, and out of it again."""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

from disco_hw.config import load_robot_config
from disco_hw.config.input_file import MODEL_TOML as MODEL_KIND
from disco_hw.config.input_file import ROBOT_TOML as ROBOT_KIND
from disco_hw.config.input_file import WAY_POINTS
from disco_hw.errors import InputError
from disco_hw.log.link import Attachment
from disco_hw.log.provenance import MODEL_TOML, PATH_CSV, ROBOT_TOML, attachment
from disco_hw.log.reader import Log
from disco_hw.runtime.robot_setup import Setup, load_setup


def kept_files(setup: Setup) -> list[Attachment]:
    """Copies of robot.toml, the model and the task's path for a log; raises InputError if one cannot be read."""
    named = (
        (ROBOT_TOML, ROBOT_KIND, setup.robot_file),
        (MODEL_TOML, MODEL_KIND, setup.model_file),
        (PATH_CSV, WAY_POINTS, setup.path_file),
    )
    return [attachment(file, name, kind) for name, kind, file in named if file is not None]


def setup_of_log(log: Log, remedy: str) -> Setup:
    """The robot as it was when a log was recorded, from the copies in it; no other file is read.

    The files that the result names are gone. Raises InputError: with `remedy` for a log without a robot.toml or
    without a file that it names, and with log and copy for one that is wrong.
    """
    names = log.attachment_names()
    if ROBOT_TOML not in names:
        raise InputError(f"{log.path}: carries no {ROBOT_TOML}; {remedy}")
    with TemporaryDirectory(prefix="disco-hw-log-") as scratch:
        files = {name: Path(scratch) / name for name in (ROBOT_TOML, MODEL_TOML, PATH_CSV) if name in names}
        for name, file in files.items():
            file.write_bytes(log.attachment(name))
        try:
            config = load_robot_config(files[ROBOT_TOML])
            if config.model.file is not None and MODEL_TOML not in names:
                raise InputError(f"{log.path}: carries no {MODEL_TOML}, which its {ROBOT_TOML} names; {remedy}")
            if config.task.file is not None and PATH_CSV not in names:
                raise InputError(f"{log.path}: carries no {PATH_CSV}, which its {ROBOT_TOML} names; {remedy}")
            return load_setup(files[ROBOT_TOML], files.get(MODEL_TOML), path_file=files.get(PATH_CSV))
        except InputError as error:
            # Nobody can look into the scratch copies, which are gone by then.
            raise InputError(str(error).replace(f"{scratch}/", f"{log.path}: ")) from None
