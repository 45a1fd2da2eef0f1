"""Recovery study of `infer`: robots drawn from the prior's plausible part, errors and coverage; pictures on request.

python -m tools.infer_study --plants 20 --drive rich --out out/infer
python -m tools.infer_study --plants 40 --foreign --out out/infer     # tools/foreign_plant.py, its slip over 0.15 s
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from disco_hw.config import Robot, RobotConfig
from disco_hw.inference.infer import InferOptions, infer
from disco_hw.inference.simulate import NAMES
from disco_hw.log.drive import Commands, DriveLog, Gyro, Poses, Wheels
from disco_hw.log.load import load_drive
from sim.plant_parameters import PlantParameters
from tools.foreign_plant import ForeignPlant, ForeignRobot
from tools.simulated_drives import make_drive
from tools.simulated_log import simulated_log, write_csv

PLAUSIBLE = {"x_icr_m": (0.0, 0.3), "wheel_radius_m": (0.04, 0.10), "axial_distance_m": (0.2, 0.5)}
LEVEL = 0.9
SLIP_S = 0.15
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
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "log.csv"
        write_csv(path, simulated_log(make_drive(drive, seed), parameters, None, seed))
        return load_drive(path, parameters.ticks_per_rev)


def foreign_robot(seed: int) -> ForeignRobot:
    """A robot with inertia, tyres that relax and slip that keeps its direction for a while; of this study's range."""
    rng = np.random.default_rng([seed, 41])
    x_icr_m, radius_m, axial_m = (float(rng.uniform(*span)) for span in PLAUSIBLE.values())
    return ForeignRobot(radius_m, axial_m, x_icr_m, grip_s=SLIP_S)


def foreign_log(robot: ForeignRobot, drive: str, seed: int) -> DriveLog:
    """One drive of a foreign robot, from what its sensors said."""
    script = make_drive(drive, seed)
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
        gyro=Gyro(np.empty(0), np.empty(0), np.empty(0, dtype=np.int64)),
    )


def recover(seed: int, drive: str, simulations: int | None = None, foreign: bool = False) -> dict[str, object]:
    """Infer one robot from one drive of it."""
    if foreign:
        robot = foreign_robot(seed)
        truth = np.array([robot.x_icr_m, robot.radius_m, robot.axle_m])
        log = foreign_log(robot, drive, seed)
    else:
        parameters = plant(seed)
        truth = np.array([getattr(parameters, name) for name in NAMES])
        log = logged(parameters, drive, seed)
    result = infer(log, config(), InferOptions(simulations=simulations, seed=seed))
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
        "seconds": result.seconds,
    }


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


def picture(results: list[dict[str, object]], path: Path) -> None:
    """Errors with 90 % bars over the truth."""
    figure = Figure(figsize=(9.0, 3.0), layout="constrained")
    truth, mean, sd = (np.array([one[key] for one in results]) for key in ("truth", "mean", "sd"))
    for index, (axis, name) in enumerate(zip(figure.subplots(1, 3), NAMES, strict=True)):
        error_mm = 1e3 * (mean - truth)[:, index]
        axis.errorbar(truth[:, index], error_mm, yerr=1.645e3 * sd[:, index], fmt="o", ms=3, color="#1f6f8b")
        axis.axhline(0.0, color="#888", lw=0.8)
        axis.set_xlabel(f"true {name}")
        axis.set_ylabel("error (mm)")
    figure.savefig(path, dpi=110)


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n", maxsplit=1)[0])
    parser.add_argument("--plants", type=int, default=20)
    parser.add_argument("--first", type=int, default=0, help="seed of the first robot")
    parser.add_argument("--drive", default="rich")
    parser.add_argument("--out", type=Path, default=Path("out/infer"))
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    results = []
    for seed in range(options.first, options.first + options.plants):
        results.append(recover(seed, options.drive))
        print(json.dumps(results[-1]), flush=True)
    picture(results, options.out / f"recovery_{options.drive}.png")
    found = figures(results)
    (options.out / f"recovery_{options.drive}.json").write_text(
        json.dumps({"figures": found, "robots": results}, indent=1), encoding="utf-8"
    )
    for key, value in found.items():
        print(f"{key} {value:.4g}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
