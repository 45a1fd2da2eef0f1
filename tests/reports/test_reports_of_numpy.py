"""Every result that a command prints or writes is JSON whatever type of numpy its numbers have."""

import json
import math
import typing
from dataclasses import asdict, fields, is_dataclass, replace
from pathlib import Path
from types import NoneType, SimpleNamespace, UnionType

import numpy as np
import pytest

from disco_hw.cli.options import print_result
from disco_hw.daemon.check import Check, CheckReport, Level
from disco_hw.daemon.emergency import EstopOutcome
from disco_hw.drive.drive_command import DriveResult
from disco_hw.experiments.adapt import CHANGES, AdaptOptions, AdaptResult, AdaptRun
from disco_hw.experiments.circle import CircleOptions, CircleResult, Run
from disco_hw.experiments.circle_report import CircleReport
from disco_hw.experiments.gap import RUNS, GapExperimentResult, Lap
from disco_hw.experiments.pendulum import PendulumOptions, PendulumResult
from disco_hw.gap import GapResult
from disco_hw.gap.report import STAGES, CandidateEvidence, ChannelFinding, EffectFinding, GapReport, UnnamedFinding
from disco_hw.gap.report.blind_spots import BlindSpot
from disco_hw.gap.search.channel_result import ParameterEstimate
from disco_hw.gap.search.cross_validation import PredictionErrors
from disco_hw.inference.checks import CHECKS, Predictive
from disco_hw.inference.infer_command import GapCheck, InferResult
from disco_hw.log.importing import Imported
from disco_hw.model import Model
from disco_hw.reports import as_json
from disco_hw.runtime.replay import ReplayReport

FLOATS = (np.float16, np.float32, np.float64, np.longdouble)
INTEGERS = (np.int8, np.int16, np.int32, np.int64, np.uint8, np.uint16, np.uint32, np.uint64)
SCALARS = (np.bool_, np.str_, *FLOATS, *INTEGERS)


def made(kind, scalar):
    """A value of an annotation, its numbers of a type of numpy."""
    origin, parts = typing.get_origin(kind), typing.get_args(kind)
    if isinstance(kind, type) and is_dataclass(kind):
        hints = typing.get_type_hints(kind)
        return kind(**{field.name: made(hints[field.name], scalar) for field in fields(kind)})
    if origin is UnionType:
        return made(next(part for part in parts if part is not NoneType), scalar)
    if origin is tuple:
        return tuple(made(part, scalar) for part in (parts[:1] * 2 if parts[-1] is ... else parts))
    if origin is dict:
        return {made(parts[0], scalar): made(parts[1], scalar)}
    of_type = {bool: np.bool_, int: np.int64, float: np.float64, str: np.str_}
    if kind in of_type:
        fits = {bool: (np.bool_,), int: INTEGERS, float: (*INTEGERS, *FLOATS), str: (np.str_,)}
        return (scalar if scalar in fits[kind] else of_type[kind])(kind is not str or "words")
    return Path("file") if kind is Path else None


def gap_report(scalar):
    stages = {stage: {scalar(horizon): made(PredictionErrors, scalar) for horizon in (1.0, 2.0)} for stage in STAGES}
    return GapReport(
        ("log",), (made(ChannelFinding, scalar),),
        (EffectFinding("motor_lag", "command_to_wheel", {"tau_s": made(ParameterEstimate, scalar)}, scalar(1)),),
        (made(UnnamedFinding, scalar),), (replace(made(BlindSpot, scalar), name="turn_slip"),),
        stages, Model(0.06, 0.4), scalar(1), candidates=(made(CandidateEvidence, scalar),),
    )  # fmt: skip


def inferred(scalar):
    ones = np.ones(4, dtype=scalar)
    inference = SimpleNamespace(
        undetermined=("x_icr_m",), draws=np.ones((9, 3)), predictive=Predictive(9.0 * np.ones(len(CHECKS)), ones, ()),
        calibration=SimpleNamespace(p_values=ones[:3], coverage=ones), fitted=SimpleNamespace(simulations=scalar(1)),
        effective_simulations=scalar(1), outside_region=scalar(1), noise=made(Lap, scalar),
        drive=SimpleNamespace(source="commands", t_s=ones, duration_s=scalar(1)),
    )  # fmt: skip
    return InferResult(inference, GapCheck(), (), Path("robot.toml"), None, np.float64(1))


def experiments(scalar):
    """What the verbs of the paper's experiments print."""
    ones = np.ones((2, 4))
    runs = {"posterior": [Run(np.ones((9, 3)), np.ones(9), np.ones((9, 2)))] * 2}
    disc = SimpleNamespace(center_x_m=scalar(1), center_y_m=scalar(1), radius_m=scalar(1), speed_m_s=scalar(1))
    circle = CircleResult(replace(CircleOptions(), lag_s=scalar(1)), disc, "default", runs)
    pendulum = PendulumResult(made(PendulumOptions, scalar), {"true parameters": ones})
    t_s = np.arange(0.0, 120.0, 0.1)
    belief = (scalar(1), np.ones(3), np.ones(3))
    plain = AdaptRun(t_s, np.ones(t_s.size), np.ones((t_s.size, 2)), (belief,))
    changed = [(name, adapted) for name in CHANGES for adapted in (False, True)]
    drives = {key: [replace(plain, cost=plain.cost * (1 + place))] for place, key in enumerate(changed)}
    adapt = AdaptResult(AdaptOptions(), None, drives)
    yield {"curves": circle.rows(), "mode": "default", "options": asdict(circle.options)}
    yield {"curves": pendulum.rows(), "options": asdict(pendulum.options)}
    with np.errstate(all="ignore"):
        yield {"changes": adapt.rows()}


def results(scalar):
    """One of each result that goes to standard output or to a file."""
    if scalar not in (np.bool_, np.str_):
        yield from (dict(one) for one in experiments(scalar))
        yield inferred(scalar).as_dict()
        report = gap_report(scalar)
        yield GapResult(report, Path("out")).as_dict()
        laps = {run: made(Lap, scalar) for run in RUNS}
        yield GapExperimentResult({"deadband": (scalar(1),)}, report, laps, {}, None).as_dict()
    yield CheckReport((Check(np.str_("link"), Level.OK, np.str_("words")),)).as_dict()
    circle = made(CircleReport, np.float64 if scalar is np.str_ else scalar)
    yield circle.as_dict()
    for kind in (ReplayReport, EstopOutcome, DriveResult, Imported):
        yield made(kind, scalar).as_dict()


@pytest.mark.parametrize("scalar", SCALARS, ids=lambda scalar: scalar.__name__)
def test_every_report_is_json_with_numbers_of_every_type_of_numpy(scalar, capsys):
    seen = 0
    for result in results(scalar):
        print_result(result, True, "")
        printed = json.loads(capsys.readouterr().out)
        assert printed == json.loads(as_json(result, indent=1))
        assert printed.keys() == result.keys()
        seen += 1
    assert seen >= 6


@pytest.mark.parametrize("scalar", SCALARS, ids=lambda scalar: scalar.__name__)
def test_a_number_of_numpy_is_written_as_the_number_it_is(scalar):
    written = json.loads(as_json({"one": scalar(1), "all": np.array([scalar(1)]), "keys": {scalar(1): [scalar(1)]}}))
    one = {np.bool_: True, np.str_: "1"}.get(scalar, 1)
    assert written["one"] == one
    assert type(written["one"]) is {np.bool_: bool, np.str_: str}.get(scalar, float if scalar in FLOATS else int)
    assert written["all"] == [one]
    assert list(written["keys"].values()) == [[one]]


@pytest.mark.parametrize("scalar", FLOATS, ids=lambda scalar: scalar.__name__)
def test_what_is_no_number_is_null_in_every_type(scalar):
    for value in (math.nan, math.inf, -math.inf):
        assert json.loads(as_json({"x": scalar(value), "y": np.array([scalar(value)])})) == {"x": None, "y": [None]}


def test_what_json_has_no_word_for_is_refused():
    with pytest.raises(TypeError, match="not JSON serializable"):
        as_json({"x": object()})
