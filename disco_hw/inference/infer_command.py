"""What `disco-hw infer` does: the inference, and beside it, in another process, the search of `gap`.

Fitted alone, the parameters absorb an effect that the model lacks, sharply and wrongly, and no width of the posterior
shows it.
"""

from __future__ import annotations

import shlex
import signal
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import asdict, dataclass, replace
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path
from time import perf_counter
from typing import Any

import numpy as np

from disco_hw.config import load_robot_config
from disco_hw.errors import InputError, WorkError
from disco_hw.inference.checks import CHECKS, LARGEST_UNEXPLAINED, LEVELS
from disco_hw.inference.excitation import excitation
from disco_hw.inference.infer import Inference, InferOptions, infer
from disco_hw.inference.simulate import NAMES, LocalWorkers, ReportProgress, Workers, dask_workers
from disco_hw.log.consistency import find_contradictions, refuse_contradictions
from disco_hw.log.contradictions import Contradiction
from disco_hw.log.drive import DriveLog
from disco_hw.log.load import load_drive
from disco_hw.model import Model, save_model
from disco_hw.reports import refuse_file


@dataclass(frozen=True, slots=True)
class GapCheck:
    """Names of `missing` effects, the surest first; `why_not_checked`: why the log could not be searched, if so."""

    missing: tuple[str, ...] = ()
    why_not_checked: str | None = None


def gap_check(log: DriveLog, model: Model) -> GapCheck:
    """Search a log for effects that a model lacks."""
    from disco_hw.gap import missing_effects  # noqa: PLC0415  (slow to import, needed only in that process)

    try:
        return GapCheck(missing_effects(log, model))
    except InputError as error:
        return GapCheck(why_not_checked=str(error))


@contextmanager
def gap_check_in_parallel(log: DriveLog, model: Model) -> Iterator[Callable[[], GapCheck]]:
    """Begin the search in a process of its own; yields what waits for its result, which raises WorkError."""
    context = get_context("spawn")
    result, send = context.Pipe(duplex=False)
    process = context.Process(target=_search, args=(send, log, model), name="gap-check", daemon=True)
    process.start()
    send.close()

    def wait() -> GapCheck:
        try:
            found: GapCheck = result.recv()
        except EOFError:
            raise WorkError("the search for missing effects was aborted; run `disco-hw gap` to see why") from None
        return found

    try:
        yield wait
    finally:
        process.terminate()
        process.join()
        result.close()


def _search(send: Connection, log: DriveLog, model: Model) -> None:
    # Ctrl-C is for the parent, which ends this process.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    send.send(gap_check(log, model))


Search = Callable[[DriveLog, Model], AbstractContextManager[Callable[[], GapCheck]]]

_SHOWN = ("wheel_radius_m", "axial_distance_m", "x_icr_m")


@dataclass(frozen=True)
class InferResult:
    """The outcome for the user; `model_path` is None if no model was asked for."""

    inference: Inference
    gap: GapCheck
    logs: tuple[Path, ...]
    robot: Path
    model_path: Path | None
    seconds: float
    contradictions: tuple[Contradiction, ...] = ()

    def as_dict(self) -> dict[str, Any]:
        """Return the result as a JSON-serialisable dict, for `--json`."""
        return {
            "contradictions": [{"cause": each.cause, "message": each.message} for each in self.contradictions],
            "posterior": posterior_figures(self.inference),
            "undetermined": list(self.inference.undetermined),
            "outside_simulated": self.inference.predictive.outside_simulated,
            "missing_effects": list(self.gap.missing),
            "gap_not_judged": self.gap.why_not_checked,
            "disagreements": [
                {"check": check.name, "deviation": deviation, "effects": list(check.effects)}
                for check, deviation in self.inference.predictive.disagreements
            ],
            "diagnostics": diagnostics(self.inference),
            "seconds": round(self.seconds, 3),
            "model": None if self.model_path is None else str(self.model_path),
        }

    def as_text(self) -> str:
        """Return the result as text for the user."""
        lines = [f"warning: {each.message}" for each in self.contradictions]
        for name, figures in posterior_figures(self.inference).items():
            low, high = figures["ci90"]
            lines.append(f"{name:<18} {figures['mean']:.4f}   90 % between {low:.4f} and {high:.4f}")
        lines += [f"undetermined: {sentence}" for sentence in self.inference.undetermined]
        lines += self.warnings()
        lines += [f"note: {note}" for note in self.inference.drive.notes]
        if self.model_path is not None:
            marked = "; `disco-hw run` refuses it without --accept-missing-effects" if self.gap.missing else ""
            lines.append(f"{self.model_path}: written in {self.seconds:.1f} s{marked}")
        return "\n".join(lines)

    def all_warnings(self) -> list[str]:
        """Return the contradictions within the logs, and the sentences of `warnings`."""
        return [*(f"warning: {each.message}" for each in self.contradictions), *self.warnings()]

    def warnings(self) -> list[str]:
        """Sentences for whoever would trust the posterior too early, the next step last."""
        lines = _disagreements(self.inference)
        if self.gap.missing:
            lines.append(
                f"warning: the robot shows {', '.join(self.gap.missing)}, which the model lacks; fitted alone, the "
                "parameters absorb it"
            )
        if self.gap.why_not_checked is not None:
            lines.append(f"warning: whether an effect is missing was not checked: {self.gap.why_not_checked}")
        elif self.gap.missing or self.inference.predictive.outside_simulated:
            words = ("disco-hw", "gap", *map(str, self.logs), "--robot", str(self.robot), "-o", "gap")
            lines.append(f"next: {shlex.join(words)}    (its gap/model.toml has what is missing)")
        return lines


def diagnostics(inference: Inference) -> dict[str, Any]:
    """Return the diagnostics of the inference as a JSON-serialisable dict."""
    calibration = inference.calibration
    return {
        "simulations": inference.fitted.simulations,
        "effective_simulations": round(inference.effective_simulations, 1),
        "sbc_p": dict(zip(NAMES, calibration.p_values.tolist(), strict=True)),
        "coverage": {f"{level:g}": share for level, share in zip(LEVELS, calibration.coverage.tolist(), strict=True)},
        "predictive_deviations": dict(
            zip((check.name for check in CHECKS), inference.predictive.deviations.tolist(), strict=True)
        ),
        "outside_region": inference.outside_region,
        "unexplained": round(inference.predictive.unexplained, 4),
        "noise": asdict(inference.noise),
        "driven_by": inference.drive.source,
        "poses": int(inference.drive.t_s.size),
        "duration_s": inference.drive.duration_s,
    }


def _disagreements(inference: Inference) -> list[str]:
    check = inference.predictive
    lines = [
        f"warning: {one.name}: {one.symptom.value}, {abs(deviation):.0f} standard deviations from every simulation "
        f"(as {' or '.join(one.effects)} would do)"
        for one, deviation in check.disagreements
    ]
    lines += [
        f"warning: the posterior of {name} lies at the edge of its prior; widen prior.{name} in robot.toml"
        for name in check.edge
    ]
    if check.unexplained > LARGEST_UNEXPLAINED:
        lines.append(
            f"warning: no geometry of the wheels explains {check.unexplained:.0%} of the motion within a second; "
            "check that the poses and wheels are of one drive and on one clock"
        )
    if check.outside_simulated:
        lines.append(
            "warning: the log lies outside the simulated range, so the parameters may have absorbed what the model "
            "lacks"
        )
    return lines


def posterior_figures(inference: Inference) -> dict[str, dict[str, Any]]:
    """Mean, standard deviation and 90 % interval of every parameter, in metres."""
    figures = {}
    for name in _SHOWN:
        draws = inference.draws[:, NAMES.index(name)]
        low, high = np.quantile(draws, [0.05, 0.95]).tolist()
        figures[name] = {"mean": float(draws.mean()), "sd": float(draws.std()), "ci90": [low, high]}
    return figures


def infer_command(
    logs: Sequence[Path],
    robot: Path,
    out: Path | None = None,
    report: Path | None = None,
    options: InferOptions | None = None,
    dask: str | None = None,
    report_progress: ReportProgress = lambda *_: None,
    search: Search = gap_check_in_parallel,
) -> InferResult:
    """Infer the geometry from logs; write the model to `out` and, if asked for, a page with pictures to `report`.

    `dask` is the address of a cluster to work on. `search` looks for effects that the nominal model lacks, while the
    inference runs; the model is marked with what it finds. Raises InputError for what the user can mend, such
    as a file that cannot be written or that is read here, before the work; WorkError for a cluster that is lost, and
    for files that cannot be written after all.
    """
    began = perf_counter()
    if out is not None:
        refuse_file(out, [*logs, robot])
    if report is not None:
        refuse_file(report, [*logs, robot, *([out] if out is not None else [])])
    config = load_robot_config(robot)
    drive = load_drive(list(logs), config.robot.ticks_per_rev, config.robot.wheel_radius_m)
    nominal = Model.nominal(config.robot)
    found_wrong = find_contradictions(drive, nominal.wheel_radius_m, nominal.axial_distance_m)
    by_commands = options is not None and options.paper
    refuse_contradictions(found_wrong, ("body", "response") if by_commands else ("body",))
    excitation(drive)
    with search(drive, nominal) as searched, _workers(dask) as workers:
        inference = infer(drive, config, options, report_progress, workers)
        report_progress("search for missing effects", 1.0)
        found = searched()
    result = InferResult(inference, found, tuple(logs), robot, out, perf_counter() - began, found_wrong)
    if out is not None:
        model = replace(inference.model(nominal), missing_effects=found.missing)
        _write(out, lambda: save_model(model, out))
    if report is not None:
        from disco_hw.inference.report import report_html  # noqa: PLC0415  (matplotlib, slow to import)

        page = report_html(inference, posterior_figures(inference), result.all_warnings())
        _write(report, lambda: report.write_text(page, encoding="utf-8"))
    return result


def _workers(dask: str | None) -> AbstractContextManager[Workers]:
    return nullcontext(LocalWorkers()) if dask is None else dask_workers(dask)


def _write(path: Path, write: Callable[[], object]) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write()
    except OSError as error:
        raise WorkError(f"{path}: cannot be written ({error.strerror}); give another path") from None
