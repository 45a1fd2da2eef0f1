"""Self-contained page report.html with the posterior, its checks and what it leaves open."""

from __future__ import annotations

import html
from collections.abc import Iterable
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from disco_hw.inference.checks import CHECKS, LARGEST_DEVIATION, LEVELS
from disco_hw.inference.infer import Inference
from disco_hw.inference.simulate import NAMES
from disco_hw.reports import ALARM, MAIN, page, picture, png

Array = NDArray[np.float64]


def report_html(inference: Inference, posterior: dict[str, dict[str, Any]], warnings: Iterable[str]) -> str:
    """Return the HTML page; `posterior` as in the JSON output, `warnings` as sentences."""
    calibration = inference.calibration
    rows = "".join(
        f"<tr><td>{name}</td><td class=n>{one['mean']:.5f}</td><td class=n>{one['sd']:.5f}</td>"
        f"<td class=n>{one['ci90'][0]:.5f}</td><td class=n>{one['ci90'][1]:.5f}</td></tr>"
        for name, one in posterior.items()
    )
    coverage = "".join(
        f"<tr><td class=n>{level:.0%}</td><td class=n>{share:.0%}</td></tr>"
        for level, share in zip(LEVELS, calibration.coverage.tolist(), strict=True)
    )
    uniform = ", ".join(f"{name} p = {p:.2g}" for name, p in zip(NAMES, calibration.p_values.tolist(), strict=True))
    drive = inference.drive
    noise = inference.noise
    parts = [
        f"<p>{drive.duration_s:.0f} s, {drive.t_s.size} poses, driven by {drive.source}; "
        f"{inference.fitted.simulations} simulations, of which the posterior rests on "
        f"{inference.effective_simulations:.0f}; seed {inference.options.seed}.</p>",
        *(f'<p class="warn">{html.escape(line)}</p>' for line in warnings),
        "<table><tr><th></th><th>mean (m)</th><th>sd</th><th>5 %</th><th>95 %</th></tr>",
        rows,
        "</table>",
        picture(png(pairs_figure(inference.draws)), "Marginals and pairs of the posterior"),
        "<h2>What stays open</h2>",
        "".join(f"<p>{html.escape(line)}</p>" for line in inference.undetermined)
        or "<p>Nothing: the log determines all three parameters.</p>",
        "<h2>Does the log look like the simulations?</h2>",
        "<p>Each bar is one way to differ from the model: how far the log is from simulations under the posterior, in "
        f"their standard deviations. Beyond {LARGEST_DEVIATION:g} the model lacks something.</p>",
        picture(png(predictive_figure(inference.predictive.deviations)), "Posterior predictive check"),
        "<h2>Can the widths be trusted?</h2>",
        "<p>Fresh simulations at known parameters: the rank of the truth among posterior draws should be uniform "
        f"({uniform}), and a region of a given probability should hold the truth that often.</p>",
        picture(png(calibration_figure(calibration.ranks)), "Simulation-based calibration"),
        f"<table><tr><th>region</th><th>holds the truth</th></tr>{coverage}</table>",
        "<h2>Noise of this log</h2>",
        f"<p>Pose sensor {1e3 * noise.position_m:.2g} mm and {np.degrees(noise.yaw_rad):.2g}&deg;; slip "
        f"{1e3 * noise.slip_forward_m_sqrt_s:.2g} mm forward, {1e3 * noise.slip_left_m_sqrt_s:.2g} mm sideways and "
        f"{np.degrees(noise.slip_yaw_rad_sqrt_s):.2g}&deg; in yaw per square root of a second. The simulations have "
        "the same.</p>",
    ]
    return page("What the drive says about the robot", "".join(parts))


def pairs_figure(draws: Array) -> Figure:
    """Marginals on the diagonal, pairs below, for draws (n, 3) in the order of `NAMES`."""
    figure = Figure(figsize=(7.5, 7.0), layout="constrained")
    axes = figure.subplots(3, 3)
    for row in range(3):
        for column in range(3):
            axis = axes[row, column]
            if column > row:
                axis.axis("off")
                continue
            if row == column:
                axis.hist(draws[:, row], bins=40, color=MAIN, density=True)
                axis.set_yticks([])
            else:
                axis.plot(draws[:2000, column], draws[:2000, row], ".", ms=1.5, alpha=0.4, color=MAIN)
            if row == 2:
                axis.set_xlabel(NAMES[column])
            if column == 0 and row:
                axis.set_ylabel(NAMES[row])
            axis.tick_params(labelsize=7, labelrotation=30)
    return figure


def predictive_figure(deviations: Array) -> Figure:
    """Draw a figure with a bar for each of `CHECKS`."""
    figure = Figure(figsize=(7.5, 4.0), layout="constrained")
    axis = figure.subplots()
    colours = [ALARM if abs(value) > LARGEST_DEVIATION else MAIN for value in deviations]
    axis.barh([check.name for check in CHECKS], deviations, color=colours)
    axis.axvspan(-LARGEST_DEVIATION, LARGEST_DEVIATION, color="#ddd", zorder=0)
    axis.invert_yaxis()
    axis.set_xlabel("deviation from simulations (standard deviations)")
    return figure


def calibration_figure(ranks: Array) -> Figure:
    """Rank histograms of ranks (n, 3), with the band that holds 95 % of the bars of a calibrated posterior."""
    bins = 15
    figure = Figure(figsize=(7.5, 2.6), layout="constrained")
    expected = ranks.shape[0] / bins
    spread = 1.96 * np.sqrt(expected * (1.0 - 1.0 / bins))
    for axis, name, column in zip(figure.subplots(1, 3), NAMES, ranks.T, strict=True):
        axis.axhspan(expected - spread, expected + spread, color="#ddd")
        axis.hist(column, bins=bins, range=(0.0, 1.0), color=MAIN)
        axis.set_xlabel(f"rank of {name}", fontsize=8)
        axis.set_yticks([])
    return figure
