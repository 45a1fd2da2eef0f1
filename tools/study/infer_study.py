"""Recovery study of `infer`: robots drawn from the prior's plausible part, errors and coverage.

python -m tools.study.infer_study --plants 20 --drive rich --out out/infer
python -m tools.study.infer_study --kind foreign --first 200 --plants 40
python -m tools.study.infer_study --kind slipping --first 200 --plants 40 --closed-form

Kinds: `own`, the robots of sim/, whose slip lasts 0.3 s; `foreign`, those of tools/foreign_plant.py, whose slip is a
part of either wheel's speed and lasts 0.05 to 0.5 s, and whose body follows its wheels late; `slipping`, the same
without that delay; `mujoco`, contact and servos of tools/mujoco_robot.py, without noise but the sensors'. What no
parameters explain: `swapped`, a slipping robot's log with the poses of another drive of it; `sliding`, one that slides
downhill by 50 mm/s. Robots that were done before with this code are not done again. With --closed-form no network is
trained: the closed-form estimates of the log are held against those of simulations at the truth, with the noise that
was measured, which is what a posterior can be at best and takes a tenth of the time.
"""

from __future__ import annotations

import argparse
import hashlib
import json
from dataclasses import replace
from pathlib import Path
from time import perf_counter

import numpy as np

from disco_hw.config import Prior, Robot, RobotConfig
from disco_hw.errors import InputError
from disco_hw.inference.checks import CHECKS, LARGEST_DEVIATION, LARGEST_UNEXPLAINED, Scores
from disco_hw.inference.estimates import estimates
from disco_hw.inference.excitation import excitation
from disco_hw.inference.infer import InferOptions, infer, noise_of, noise_spread
from disco_hw.inference.noise import unexplained_share
from disco_hw.inference.simulate import NAMES, Simulator, draw_seeds
from disco_hw.log.drive import Commands, DriveLog, Poses, Wheels
from disco_hw.model import Model
from sim.plant_parameters import PlantParameters
from tools.foreign_plant import ForeignPlant, ForeignRobot
from tools.joystick import TOP_RAD_S
from tools.mujoco_robot import COUNTS_PER_TURN, TRACK_M, WHEEL_RADIUS_M, record
from tools.simulated_drives import create_drive
from tools.simulated_log import read_back, simulated_log

PLAUSIBLE = {"x_icr_m": (0.0, 0.3), "wheel_radius_m": (0.04, 0.10), "axial_distance_m": (0.2, 0.5)}
LEVEL = 0.9
WITHIN = 1.6449
SIMULATED, SCORED = 100, 40
KINDS = ("own", "foreign", "slipping", "mujoco", "swapped", "sliding")
SLIP_S = (0.05, 0.5)
SLIDING_M_S = 0.05
READ_S = 0.02


def config() -> RobotConfig:
    return RobotConfig(
        robot=Robot(
            name="study", wheel_radius_m=0.06, axial_distance_m=0.4, ticks_per_rev=2048, max_wheel_speed_rad_s=8.0
        )
    )


def plant(seed: int) -> PlantParameters:
    """A robot of the study, with sensor noise, disturbances and quantised encoders."""
    rng = np.random.default_rng([seed, 77])
    x_icr_m, radius_m, axial_m = (float(rng.uniform(*span)) for span in PLAUSIBLE.values())
    return PlantParameters(x_icr_m=x_icr_m, wheel_radius_m=radius_m, axial_distance_m=axial_m).with_ideal_motors()


def logged(parameters: PlantParameters, drive: str, seed: int) -> DriveLog:
    """One drive of a robot, by way of a CSV file."""
    return read_back(simulated_log(create_drive(drive, seed), parameters, None, seed), parameters.ticks_per_rev)


def foreign_robot(seed: int, kind: str) -> ForeignRobot:
    """A robot of this study's range in a plant of other equations; what lasts is drawn too."""
    rng = np.random.default_rng([seed, 41])
    x_icr_m, radius_m, axle_m = (float(rng.uniform(*span)) for span in PLAUSIBLE.values())
    grip_s = float(np.exp(rng.uniform(*np.log(SLIP_S))))
    robot = ForeignRobot(radius_m, axle_m, x_icr_m, grip_s=grip_s)
    if kind == "foreign":
        return robot
    fast = replace(robot, mass_kg=20.0, inertia_kg_m2=2.5 * axle_m**2, relaxation_m=0.0015, side_s=0.003)
    return replace(fast, slope_m_s=SLIDING_M_S) if kind == "sliding" else fast


def foreign_log(robot: ForeignRobot, drive: str, seed: int) -> DriveLog:
    """One drive of a foreign robot, from what its sensors said."""
    script = create_drive(drive, seed)
    plant = ForeignPlant(robot, (0.0, 0.0, 0.0), seed)
    wheels: list[tuple[float, ...]] = []
    poses: list[tuple[float, ...]] = []
    for command in zip(script.left_rad_s.tolist(), script.right_rad_s.tolist(), strict=True):
        for _ in range(round(script.period_s / READ_S)):
            read = plant.readings()
            wheels += [
                (w.t_ns * 1e-9, w.left_angle_rad, w.right_angle_rad, w.left_speed_rad_s, w.right_speed_rad_s)
                for w in read.wheels
            ]
            poses += [(p.t_ns * 1e-9, p.x_m, p.y_m, p.yaw_rad) for p in read.poses]
            plant.advance(*command, round(READ_S * 1e3))
    wheel_columns, pose_columns = np.array(wheels).T, np.array(poses).T
    one = [np.zeros(size, dtype=np.int64) for size in (script.t_s.size, wheel_columns.shape[1], pose_columns.shape[1])]
    return DriveLog(
        sources=("foreign",),
        commands=Commands(script.t_s, script.left_rad_s, script.right_rad_s, one[0]),
        wheels=Wheels(*wheel_columns, one[1], True, True),
        poses=Poses(*pose_columns, one[2]),
    )


def mujoco_log(seed: int) -> tuple[DriveLog, np.ndarray]:
    """A person's drive in MuJoCo, and x_icr, wheel radius and the axle that fits what wheels and body really did."""
    driven = record({}, seed)
    turned = driven.turned[:, [1, 3]].mean(axis=1) - driven.turned[:, [0, 2]].mean(axis=1)
    steps = slice(None, None, 240)
    roll, yaw = np.diff(turned[steps]), np.diff(driven.truth[steps, 2])
    return driven.as_drive(), np.array([0.0, WHEEL_RADIUS_M, WHEEL_RADIUS_M * float(roll @ roll) / float(roll @ yaw)])


def study_log(seed: int, kind: str, drive: str) -> tuple[DriveLog, np.ndarray, RobotConfig]:
    """A log, the parameters (3,) of its robot in the order of `NAMES`, and what the robot is thought to be."""
    if kind == "own":
        parameters = plant(seed)
        return logged(parameters, drive, seed), np.array([getattr(parameters, name) for name in NAMES]), config()
    if kind == "mujoco":
        robot = Robot(
            name="mujoco",
            wheel_radius_m=1.05 * WHEEL_RADIUS_M,
            axial_distance_m=2.0 * TRACK_M,
            ticks_per_rev=COUNTS_PER_TURN,
            max_wheel_speed_rad_s=TOP_RAD_S,
        )
        prior = Prior(x_icr_m=(-0.3, 0.3), wheel_radius_m=(0.05, 0.3), axial_distance_m=(0.3, 2.0))
        return *mujoco_log(seed), RobotConfig(robot=robot, prior=prior)
    foreign = foreign_robot(seed, kind)
    log = foreign_log(foreign, drive, seed)
    if kind == "swapped":
        log = replace(log, poses=foreign_log(foreign, drive, seed + 10_000).poses)
    return log, np.array([foreign.x_icr_m, foreign.radius_m, foreign.axle_m]), config()


def recover(seed: int, kind: str, drive: str) -> dict[str, object]:
    """Infer one robot from one drive of it; `refused` holds the reason where nothing can be inferred."""
    log, truth, robot = study_log(seed, kind, drive)
    try:
        result = infer(log, robot, InferOptions(seed=seed))
    except InputError as error:
        return {"seed": seed, "refused": str(error)}
    low, high = np.quantile(result.draws, [0.5 - LEVEL / 2, 0.5 + LEVEL / 2], axis=0)
    return {
        "seed": seed,
        "truth": truth.tolist(),
        "mean": result.draws.mean(axis=0).tolist(),
        "sd": result.draws.std(axis=0).tolist(),
        "rank": (result.draws < truth).mean(axis=0).tolist(),
        "inside": ((low <= truth) & (truth <= high)).tolist(),
        "sbc_p": result.calibration.p_values.tolist(),
        "outside_simulated": result.predictive.outside_simulated,
        "disagreements": [check.name for check, _ in result.predictive.disagreements],
        "seconds": result.seconds,
    }


def closed_form(seed: int, kind: str, drive: str) -> dict[str, object]:
    """Study the closed-form estimates, against simulations at the truth with the noise that was measured."""
    log, truth, robot = study_log(seed, kind, drive)
    began = perf_counter()
    driven, model = excitation(log), Model.nominal(robot.robot)
    measured = noise_of(driven)
    plain = estimates(driven, measured).theta(driven.pose[None])[0]
    known = noise_spread(Simulator(model, driven, measured), plain, seed)
    weights = estimates(driven, known.noise)
    simulator = Simulator(model, driven, known.noise, known.factor)
    poses = simulator.poses(np.tile(truth, (SIMULATED, 1)), draw_seeds(SIMULATED, np.random.default_rng(seed)))
    found, fits = weights.theta(driven.pose[None])[0], weights.theta(poses)
    mean, sd = found - (fits.mean(axis=0) - truth), fits.std(axis=0)
    scores = Scores(driven, weights)
    simulated = np.array([scores(one) for one in poses[:SCORED]])
    spread = simulated.std(axis=0)
    unexplained = unexplained_share(driven, found)
    deviations = (scores(driven.pose) - simulated.mean(axis=0)) / np.where(spread > 1e-12, spread, np.inf)
    return {
        "seed": seed,
        "truth": truth.tolist(),
        "mean": mean.tolist(),
        "sd": sd.tolist(),
        "inside": (np.abs(mean - truth) < WITHIN * sd).tolist(),
        "outside_simulated": bool(np.abs(deviations).max() > LARGEST_DEVIATION or unexplained > LARGEST_UNEXPLAINED),
        "unexplained": unexplained,
        "disagreements": [
            check.name for check, off in zip(CHECKS, deviations, strict=True) if abs(off) > LARGEST_DEVIATION
        ],
        "seconds": perf_counter() - began,
    }


def study(kind: str, drive: str, seeds: range, out: Path, is_closed_form: bool) -> list[dict[str, object]]:
    """Recover robots, those not done before with this code; a line of JSON each is kept in `out`."""
    digest = hashlib.sha256()
    for file in (*sorted(Path("disco_hw/inference").glob("*.py")), Path("tools/foreign_plant.py"), Path(__file__)):
        digest.update(file.read_bytes())
    path = out / f"{kind}_{drive}_{'closed_form_' if is_closed_form else ''}{digest.hexdigest()[:12]}.jsonl"
    lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    done = {one["seed"]: one for one in map(json.loads, lines)}
    for seed in seeds:
        if seed not in done:
            done[seed] = (closed_form if is_closed_form else recover)(seed, kind, drive)
            with path.open("a", encoding="utf-8") as kept:
                kept.write(json.dumps(done[seed]) + "\n")
            print(json.dumps(done[seed]), flush=True)
    return [done[seed] for seed in seeds]


def figures(results: list[dict[str, object]]) -> dict[str, float]:
    """The study in figures."""
    truth, mean, sd = (np.array([one[key] for one in results]) for key in ("truth", "mean", "sd"))
    error = np.abs(mean - truth)
    inside = np.array([one["inside"] for one in results])
    found: dict[str, float] = {
        "x_icr.median_error_m": float(np.median(error[:, 0])),
        "wheel_radius.median_error": float(np.median(error[:, 1] / truth[:, 1])),
        "axial_distance.median_error": float(np.median(error[:, 2] / truth[:, 2])),
    }
    for index, name in enumerate(NAMES):
        found[f"{name}.coverage90"] = float(inside[:, index].mean())
        found[f"{name}.rms_z"] = float(np.sqrt(np.mean(((mean - truth) / sd)[:, index] ** 2)))
    found["outside_simulated"] = float(np.mean([one["outside_simulated"] for one in results]))
    found["seconds.median"] = float(np.median([one["seconds"] for one in results]))
    return found


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n", maxsplit=1)[0])
    parser.add_argument("--kind", choices=KINDS, default="own")
    parser.add_argument("--plants", type=int, default=20)
    parser.add_argument("--first", type=int, default=0, help="seed of the first robot")
    parser.add_argument("--drive", default="rich")
    parser.add_argument("--closed-form", action="store_true", help="train no network")
    parser.add_argument("--out", type=Path, default=Path("out/infer"))
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    seeds = range(options.first, options.first + options.plants)
    results = study(options.kind, options.drive, seeds, options.out, options.closed_form)
    evaluated = [one for one in results if "refused" not in one]
    flagged = sum(bool(one["outside_simulated"]) for one in evaluated)
    refused = len(results) - len(evaluated)
    print(f"{len(results)} logs: {refused} refused, {flagged} said to lie outside what was simulated")
    if evaluated:
        inside = np.array([one["inside"] for one in evaluated]).sum(axis=0).tolist()
        coverage = ", ".join(f"{name} {count} of {len(evaluated)}" for name, count in zip(NAMES, inside, strict=True))
        print(f"90 % intervals hold {coverage}")
        found = figures(evaluated)
        (options.out / f"recovery_{options.kind}_{options.drive}.json").write_text(
            json.dumps({"figures": found, "robots": results}, indent=1), encoding="utf-8"
        )
        for key, value in found.items():
            print(f"{key} {value:.4g}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
