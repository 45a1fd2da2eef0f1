"""`make gap-study KIND=mujoco`: the search for missing effects on a robot in MuJoCo that shares nothing with the model.

For each seed and each hidden effect a person-like drive is searched, and models learnt from it predict another drive
that nobody saw. Writes `gap_mujoco.md`; results are kept, drive by drive, for this state of the code.
"""

from __future__ import annotations

import argparse
import math
import os
import re
import sys
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

# A second thread for the small matrices of a search only spins beside the first one.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import msgspec
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares, minimize_scalar
from scipy.signal import lfilter

from disco_hw.effects.registry import REGISTRY
from disco_hw.gap import search_log
from disco_hw.gap.data.gridded_drive import grid_drive
from disco_hw.gap.report import EffectFinding
from disco_hw.gap.report.judge import Measured, classify_findings, effect_findings, unnamed_findings
from disco_hw.gap.report.page import other_known_symptoms
from disco_hw.gap.settings import DEFAULT_SETTINGS
from disco_hw.model import Model
from disco_hw.model.terms import BODY_FEATURES, BODY_MEMORIES
from tools.gap.halves import STAGES, StageModels, unseen_errors
from tools.gap.study import revision, write_whole
from tools.joystick import STEPS_PER_COMMAND, STEPS_PER_S
from tools.mujoco_robot import (
    DOWNHILL_RAD,
    DURATION_S,
    EFFECTS,
    ROBOTS,
    Habits,
    Hidden,
    Recording,
    Robot,
    record,
)

AHEAD_S = 2.0
SIDES = ([0, 2], [1, 3])
"""The left wheels and the right ones."""
OTHER_HABITS = 100
"""From this number on a robot is drawn with how it is driven and logged."""
UNSEEN = 1000
"""The drive that nobody saw has a seed that is so much larger."""
NAMES = {
    "command_delay": ("command_delay", "delay_s"),
    "motor_lag": ("motor_lag", "tau_s"),
    "dead_band": ("deadband", "width_rad_s"),
    "dry_friction": ("deadband", "width_rad_s"),
    "unequal_wheels": ("wheel_radius_asymmetry", "ratio"),
    "pose_latency": ("pose_latency", "latency_s"),
    "slope": ("downhill_slide", ""),
    "payload": ("lateral_icr", "offset_m"),
    "worn_tyre": ("turn_asymmetry", "share"),
}
"""The model's effect that stands for what is hidden, and its parameter; the others have no name in the model."""


@dataclass(frozen=True)
class Result:
    """What was found in one drive: errors 2 s ahead on the unseen one by stage, mm and mrad.

    `truth`: of the parameter that stands for what is hidden, None where nothing does. `floor`: the report's
    error by the sensors' noise; `injected`: that of the noise that was added; yaw in mrad.
    """

    hidden: str
    seed: int
    named: dict[str, dict[str, float]]
    unnamed: list[str]
    doubtful: list[str]
    truth: float | None
    offered: str
    unseen: dict[str, tuple[float, float]]
    floor: tuple[float, float]
    injected: tuple[float, float]
    cpu_s: float

    @property
    def found(self) -> float | None:
        """The value found of what was hidden; of a slope the way it falls (rad)."""
        effect, parameter = NAMES.get(self.hidden, ("", ""))
        values = self.named.get(effect)
        if values is None:
            seen_too = REGISTRY[effect].witness if effect else None
            return next(iter(self.named.get(seen_too or "", {}).values()), None)
        return values[parameter] if parameter else math.atan2(values["slide_y_m"], values["slide_x_m"])

    @property
    def right(self) -> bool:
        """Whether what was hidden is named, within a tenth of its size."""
        return self.found is not None and self.truth is not None and abs(self.found / self.truth - 1.0) <= 0.1

    def over_timed(self, stage: str) -> tuple[float, float]:
        """Errors of a stage over those of `timed`, of position and of heading."""
        one, timed = self.unseen[stage], self.unseen["timed"]
        return one[0] / timed[0], one[1] / timed[1]


def robot_of(name: str) -> Robot:
    """The robot of a name, or the one that a number draws. Raises ValueError for what is neither."""
    return ROBOTS[name] if name in ROBOTS else drawn(int(name))


def drawn(number: int) -> Robot:
    """A robot whose size, weight, servos, sensors and floor, and the sizes of what may be hidden in it, a number draws.

    Wheels of 55 to 190 mm, and the mass that goes with them (3 to 140 kg); all friction of a wheel takes 0.35 to 1
    rad/s from its motor. From 100 on the number draws too how the robot is driven and logged.
    """
    usual = Robot()
    draw = np.random.default_rng([number, 99]).uniform

    def times(low: float, high: float) -> float:
        return math.exp(draw(math.log(low), math.log(high)))

    radius_m = times(0.055, 0.19)
    scale = radius_m / usual.wheel_radius_m
    track_m = radius_m * draw(3.3, 4.6)
    wheelbase_m = track_m * draw(0.62, 1.05)
    base_kg = usual.base_kg * scale**2.7 * draw(0.75, 1.35)
    wheel_kg = usual.wheel_kg * scale**2.7 * draw(0.8, 1.2)
    mass_kg = base_kg + 4.0 * (wheel_kg + 0.13)
    friction = draw(0.42, 0.9)
    # What all the friction of a wheel asks of its motor.
    scrub_nm = friction * mass_kg * 9.81 / 4.0 * radius_m
    servo_nm_s = scrub_nm / draw(0.35, 1.0)
    torque_nm = scrub_nm * draw(3.0, 5.5)
    top_rad_s = draw(0.55, 1.25) / radius_m
    length, width, height = usual.half_m
    half_m = (length * scale * draw(0.9, 1.1), width * scale * draw(0.9, 1.1), height * scale)
    sizes = {
        "command_delay": draw(0.06, 0.25), "motor_lag": draw(0.1, 0.33), "dry_friction": draw(0.06, 0.12) * top_rad_s,
        "unequal_wheels": draw(0.018, 0.05), "pose_latency": draw(0.08, 0.25), "slope": draw(3.5, 8.0),
        "payload": mass_kg * draw(0.25, 0.4), "torque_limit": scrub_nm * draw(0.8, 1.15),
        "worn_tyre": draw(0.3, 0.55), "backlash": draw(0.05, 0.16),
    }  # fmt: skip
    sizes["dead_band"] = sizes["dry_friction"]
    return Robot(
        wheel_radius_m=radius_m,
        track_m=track_m,
        wheelbase_m=wheelbase_m,
        top_rad_s=top_rad_s,
        counts_per_turn=int(times(700, 5000)),
        position_std_m=times(0.0012, 0.008),
        yaw_std_rad=times(0.003, 0.01),
        servo_nm_s=servo_nm_s,
        servo_lag_s=draw(0.02, 0.075),
        torque_nm=torque_nm,
        friction=friction,
        base_kg=base_kg,
        half_m=half_m,
        above_m=usual.above_m * scale,
        wheel_kg=wheel_kg,
        wheel_half_m=usual.wheel_half_m * scale,
        rotor_kg_m2=mass_kg * radius_m**2 * draw(0.06, 0.2),
        bearing_nm_s=0.0017 * servo_nm_s,
        payload_m={name: of * scale for name, of in usual.payload_m.items()},
        sizes=sizes,
        habits=_habits(number) if number >= OTHER_HABITS else Habits(),
    )


def _habits(number: int) -> Habits:
    """Keys or a joystick, slowly or not for long; 10 to 40 commands, 15 to 60 readings and 10 to 30 poses a second."""
    rng = np.random.default_rng([number, 777])
    pose_every, reading_every, command_every = (
        int(rng.choice(options)) for options in ([1, 2, 3], [1, 2, 4], [1, 2, 4])
    )
    jitter_s, lost = float(rng.choice([0.0, 0.002, 0.006])), float(rng.choice([0.0, 0.02, 0.1]))
    style = rng.choice(["joystick", "keyboard", "short", "slow"])
    return Habits(
        seconds={"short": 70.0, "slow": 200.0}.get(style, DURATION_S),
        pace=0.5 if style == "slow" else 1.0,
        keyboard=bool(style == "keyboard"),
        command_every=command_every,
        reading_every=reading_every,
        pose_every=pose_every,
        jitter_s=jitter_s,
        lost=lost,
    )


def truth_of(hidden: str, recording: Recording, beside: Sequence[str] = ()) -> float | None:
    """What is true of the parameter that stands for what was hidden.

    A delay and a lag are those that the true wheels show, the servo's own included. How late poses are is how far they
    lie behind the true wheels: the body's own lag, as tyres slip before they push, comes on top, less what the forms
    `beside` it hold of that. A payload's is what the true motion shows: the forward speed of the middle that turning
    makes, with those forms, as a share of a curve depends on what else has a share in it. A worn tyre's is how much
    further the same difference of the true wheels turns the robot to the left.
    """
    if hidden not in NAMES:
        return None
    size = recording.hidden.get(hidden, 0.0)
    match hidden:
        case "command_delay" | "motor_lag":
            return response_of(recording)[hidden]
        case "pose_latency":
            return size + body_lag_s(recording, beside)
        case "unequal_wheels":
            return size / (2.0 + size)
        case "slope":
            return DOWNHILL_RAD
        case "payload":
            every = slice(None, None, 48)
            t_s, (x, y, yaw) = recording.truth_s[every], recording.truth[every].T
            way = np.gradient(x, t_s) * np.cos(yaw) + np.gradient(y, t_s) * np.sin(yaw)
            wheels = np.gradient(recording.turned[every].mean(axis=1), t_s)
            rate = np.gradient(yaw, t_s)
            speed = recording.robot.wheel_radius_m * wheels
            forms = [re.sub(r"abs\((\w+)\)", r"|\1|", form.split(" ", 3)[3]) for form in beside if form[:4] == "v_x "]
            known = [
                BODY_FEATURES[form](speed, rate, np.gradient(speed, t_s), t_s)
                for form in forms
                if form in BODY_FEATURES
            ]
            causes = np.column_stack([wheels, rate, *known])
            return float(np.linalg.lstsq(causes, way, rcond=None)[0][1])
        case "worn_tyre":
            every = slice(None, None, 48)
            t_s, yaw, turned = recording.truth_s[every], recording.truth[every, 2], recording.turned[every]
            left, right = (np.gradient(turned[:, side].mean(axis=1), t_s) for side in SIDES)
            causes = np.column_stack([right - left, np.abs(right - left), right + left])
            both, one_way, _ = np.linalg.lstsq(causes, np.gradient(yaw, t_s), rcond=None)[0]
            return float(one_way / both)
    return size


def response_of(recording: Recording) -> dict[str, float]:
    """Delay and time constant (s) by which the true wheels follow, the mean of both sides, which turning leaves alone.

    Least squares on how far they turn from one twentieth of a second to the next, without any noise.
    """
    t_s, asked = recording.truth_s, recording.command.mean(axis=1)
    asked = np.repeat(asked, STEPS_PER_COMMAND * recording.robot.habits.command_every)[: t_s.size]
    every = slice(None, None, STEPS_PER_S // 20)
    turned = np.diff(recording.turned.mean(axis=1)[every])

    def off(values: NDArray[np.float64]) -> NDArray[np.float64]:
        delay_s, lag_s, gain = values
        keep = math.exp(-1.0 / (STEPS_PER_S * lag_s))
        speed = lfilter([1.0 - keep], [1.0, -keep], np.interp(t_s - delay_s, t_s, asked))
        # Angles are those before a step, as recorded.
        return np.asarray(np.diff(gain * (np.cumsum(speed) - speed)[every] / STEPS_PER_S) - turned)

    delay_s, lag_s, _ = least_squares(off, [0.05, 0.08, 1.0], x_scale=[0.01, 0.01, 0.01], diff_step=1e-3).x
    return {"command_delay": float(delay_s), "motor_lag": float(lag_s)}


def body_lag_s(recording: Recording, beside: Sequence[str] = ()) -> float:
    """How far the true body follows behind the true wheels (s): the shift that fits the speeds of its two sides best.

    Forward and turning speeds are as large as the wheels make them, by a factor of each, without any noise; forward
    ones with what tyres that slip make of them in the forms `beside` it.
    """
    every = slice(None, None, 8)
    t_s, (x, y, yaw), turned = recording.truth_s[every], recording.truth[every].T, recording.turned[every]
    forward = np.gradient(x, t_s) * np.cos(yaw) + np.gradient(y, t_s) * np.sin(yaw)
    turning = np.gradient(yaw, t_s) * recording.robot.track_m / 2
    left, right = (recording.robot.wheel_radius_m * np.gradient(turned[:, side].mean(axis=1), t_s) for side in SIDES)
    way = recording.robot.wheel_radius_m * recording.turned.mean(axis=1)
    rolling = np.gradient(way, recording.truth_s)
    for form in beside:
        _, _, k, feature = form.split(" ", 3)
        if "slewed" in feature:
            slipping = BODY_MEMORIES["v_x"][feature].at_nodes(1.0 / STEPS_PER_S, rolling, 0.0 * rolling)
            way = way + float(k) * np.cumsum(slipping) / STEPS_PER_S
    driven = np.gradient(way[every], t_s)

    def off(lag_s: float) -> float:
        squares = 0.0
        for wheels, body in ((driven, forward), ((right - left) / 2, turning)):
            earlier = np.interp(t_s - lag_s, t_s, wheels)
            scale = max(float(earlier @ earlier), 1e-12)
            squares += float(((body - (earlier @ body) / scale * earlier) ** 2).sum())
        return squares

    return float(minimize_scalar(off, bounds=(-0.1, 0.2), method="bounded", options={"xatol": 1e-4}).x)


def injected_floor(recording: Recording) -> tuple[float, float]:
    """What the noise that was put in makes of a perfect prediction, mm and mrad.

    The start is a mean of the poses within reach of it, the end a single pose.
    """
    period_s = float(np.median(np.diff(recording.pose_s)))
    reach, ahead = round(DEFAULT_SETTINGS.prediction.pose_reach_s / period_s), round(AHEAD_S / period_s)
    window = np.ones(2 * reach + 1) / (2 * reach + 1)
    start = np.column_stack([np.convolve(each, window, "valid") for each in recording.noise.T])[: -ahead - reach]
    end = recording.noise[reach + ahead :][: len(start)]
    start = start[: len(end)]
    where = np.column_stack(
        [np.interp(recording.pose_s, recording.truth_s, recording.truth[:, column]) for column in (0, 1)]
    )
    way = where[reach + ahead :][: len(start)] - where[reach:][: len(start)]
    off = end - start
    off[:, 0] += way[:, 1] * start[:, 2]
    off[:, 1] -= way[:, 0] * start[:, 2]
    return 1e3 * float(np.sqrt((off[:, :2] ** 2).sum(axis=1).mean())), 1e3 * float(np.sqrt((off[:, 2] ** 2).mean()))


def work(hidden: str, seed: int, robot: Robot = ROBOTS["middle"]) -> Result:
    """Make a drive and one that is kept back, search the first as `disco-hw gap` does, predict the other."""
    sizes: Hidden = {hidden: robot.size(hidden)} if hidden in EFFECTS else {}
    seen, kept_back = record(sizes, seed, robot=robot), record(sizes, seed + UNSEEN, robot=robot)
    nominal = Model(robot.wheel_radius_m, robot.track_m, 0.0)
    began = time.process_time()
    analysis, _ = search_log(seen.as_drive(), nominal)
    fitted = StageModels.of(analysis, nominal)
    fits, unnamed = effect_findings(analysis, fitted.final), unnamed_findings(analysis)
    named, doubtful = classify_findings(fits, Measured.of(analysis, fitted.final))
    cpu_s = time.process_time() - began
    unseen = unseen_errors(grid_drive(kept_back.as_drive()), fitted.models, AHEAD_S)
    floor = fitted.table["floor"][AHEAD_S]
    return Result(
        hidden=hidden,
        seed=seed,
        named=_values(named),
        unnamed=[term.form for term in unnamed],
        doubtful=[doubt.name for doubt in doubtful],
        truth=truth_of(hidden, seen, [term.form for term in unnamed]),
        offered=fitted.offered,
        unseen={stage: (1e3 * errors.position_m, 1e3 * errors.yaw_rad) for stage, errors in unseen.items()},
        floor=(1e3 * floor.position_m, 1e3 * floor.yaw_rad),
        injected=injected_floor(seen),
        cpu_s=cpu_s,
    )


def _values(named: Iterable[EffectFinding]) -> dict[str, dict[str, float]]:
    """Values of what is named, by name; of what a parameter says by itself by its own name, too."""
    values = {each.name: {key: part.value for key, part in each.parameters.items()} for each in named}
    besides = {
        f"{each.name}.{key}": {key: each.parameters[key].value} for each in named for key in other_known_symptoms(each)
    }
    return values | besides


def row(of: Result) -> str:
    """One line of the table."""
    known = "" if of.truth is None else f"{of.truth:.3g}"
    found = "" if of.found is None else f"{of.found:.3g}"
    # A pipe within a term would end the cell.
    others = [name.replace("|", "\\|") for name in (*of.named, *of.unnamed) if name != NAMES.get(of.hidden, ("",))[0]]
    errors = [f"{of.unseen[stage][0]:.0f} / {of.unseen[stage][1]:.0f}" for stage in STAGES]
    position, yaw = of.over_timed(of.offered)
    floor = f"{of.floor[0]:.1f} / {of.floor[1]:.1f} | {of.injected[0]:.1f} / {of.injected[1]:.1f}"
    cells = [
        of.hidden,
        str(of.seed),
        known,
        found,
        ", ".join(others),
        *errors,
        of.offered,
        f"{position:.2f} / {yaw:.2f}",
    ]
    return "| " + " | ".join([*cells, floor]) + " |"


def table(results: Sequence[Result]) -> list[str]:
    """All drives as Markdown, with what was counted over them."""
    known = [result for result in results if result.truth is not None]
    worse = sum(max(result.over_timed(result.offered)) > 1.05 for result in results)
    floors = [abs(of.floor[part] / of.injected[part] - 1.0) for of in results for part in (0, 1)]
    return [
        "| hidden | seed | true | found | named besides | refitted, mm / mrad | timed | amended | offered | over timed "
        "| floor | noise put in |",
        "|---" * 12 + "|",
        *map(row, results),
        "",
        f"Named, and right within 10 %: {sum(result.right for result in known)} of {len(known)}.",
        f"Offered worse than timed by over 5 % on the unseen drive: {worse} of {len(results)}.",
        f"Floor within 20 % of the noise put in: {sum(each <= 0.2 for each in floors)} of {len(floors)}.",
        f"CPU of a search, median: {np.median([result.cpu_s for result in results]):.1f} s.",
    ]


def study(hidden: Iterable[str], seeds: Iterable[int], out: Path, robot: str = "middle") -> list[Result]:
    """All results, from before with this code or new, each kept as soon as it is there."""
    folder = out / "results" / f"mujoco-{revision()}"
    folder.mkdir(parents=True, exist_ok=True)
    names, results = list(hidden), []
    for seed in seeds:
        for name in names:
            path = folder / f"{robot}-{name}-{seed}.json"
            if path.exists():
                result = msgspec.json.decode(path.read_bytes(), type=Result)
            else:
                result = work(name, seed, robot_of(robot))
                write_whole(path, msgspec.json.encode(result).decode())
            results.append(result)
            print(row(result), file=sys.stderr, flush=True)
    name = "gap_mujoco.md" if robot == "middle" else f"gap_mujoco_{robot}.md"
    (out / name).write_text("\n".join(table(results)) + "\n", encoding="utf-8")
    return results


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m tools.gap.mujoco", description=(__doc__ or "").split("\n")[0])
    parser.add_argument("hidden", nargs="*", metavar="EFFECT", help=f"of nothing, {', '.join(EFFECTS)} (all)")
    which = f"{', '.join(ROBOTS)}, or a number, which draws one (middle)"
    parser.add_argument("--robot", default="middle", help=which)
    parser.add_argument("--seeds", type=int, default=3, help="drives of each hidden effect (3)")
    parser.add_argument("--first", type=int, default=1, help="first seed (1)")
    parser.add_argument("-o", "--out", type=Path, default=Path("out/gap_study"), help="directory to write to")
    options = parser.parse_args(arguments)
    unknown = set(options.hidden) - {"nothing", *EFFECTS}
    if unknown:
        parser.error(f"no such effect: {', '.join(sorted(unknown))}; write some of nothing, {', '.join(EFFECTS)}")
    if options.robot not in ROBOTS and not options.robot.isdecimal():
        parser.error(f"--robot {options.robot}: no such robot; write {which}")
    seeds = range(options.first, options.first + options.seeds)
    print("\n".join(table(study(options.hidden or ["nothing", *EFFECTS], seeds, options.out, options.robot))))
    return 0


if __name__ == "__main__":
    sys.exit(main())
