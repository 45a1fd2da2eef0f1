"""Every threshold and choice of the gap analysis, in one place, with where each comes from.

Marks: *measured*, on simulated or real logs with nothing hidden or something known; *literature*, with its source;
*chosen*, by what is physically plausible or what costs little, without a study behind it. Sizes in SI units; the names
carry the unit; "nats" are units of log likelihood. What belongs to one effect (where its fit starts, its ranges) is in
that effect's file, not here.
"""

from __future__ import annotations

from dataclasses import dataclass

# Compiled into the free runs and the filters, and so no settings.
GRID_STEP_S = 0.01
"""Grid of the free runs, s. Chosen: half the period of commands at 50 Hz."""
DRIFT_S = 20.0
"""Correlation time of the slow error of a wheel's speed, s. Chosen: longer than any manoeuvre of a log."""
# No choice at all.
OF_MEDIAN = 1.4826
"""Standard deviation of a normal distribution over the median of its absolute values."""


@dataclass(frozen=True, slots=True)
class GridSettings:
    """Settings of the conversion of a log to a drive on an even grid."""

    block_s: float = 3.0
    """Blocks of time that are left out together, and windows of poses, the start of which is unknown. Chosen."""
    longest_s: float = 320.0
    """Of a longer drive so much is judged, stretches with commands first. Chosen: it bounds how long a search takes."""
    stretch_s: float = 20.0
    """Length of the stretches that are picked of a long drive. Chosen: several manoeuvres each."""
    longest_silence_s: float = 1.5
    """Where wheel samples fail to come for longer a run ends, where poses do a window. Chosen."""
    speed_span_s: float = 0.03
    """Speeds are differences of the angle over so long either side, s. Chosen: a few encoder periods."""
    even_samples: int = 10
    """Time stamps are made even over so many neighbours either side. Chosen."""
    longest_response_s: float = 1.5
    """Wheels answer a command within this time. Chosen."""
    rest_rad_s: float = 0.05
    """Wheels that turn more slowly rest, and commands below ask for nothing. Chosen."""
    turning_rad_s: float = 0.3
    """Wheels that turn so fast without a command are driven by another master. Chosen."""
    loud_rad_s: float = 2.0
    """Wheels that rest under such a command do not listen to it. Chosen."""
    fewest_samples: int = 60
    """Fewer samples judge nothing: encoder readings the wheels, poses the body and their clock, either a regime.
    Chosen."""
    repeated_share: float = 0.3
    """Wheel speeds of which more than this share repeat the last one are held. Chosen: a Husky's do in most samples."""
    repeated_periods: float = 4.0
    """A value that is repeated for longer than so many periods was measured again. Chosen."""
    lead_s: float = 1.0
    """After a run's start so long nothing is predicted, as what was commanded before is not known. Shorter runs are
    left out. Chosen."""
    lead_share: float = 0.25
    """And of a short run so much of it at most. Chosen: windows of 2 s are predicted 1 s ahead."""
    start_every_s: float = 0.2
    """Predictions start so far apart. Chosen: neighbours then differ, and a minute has 300."""
    most_pose_delay_s: float = 1.0
    """Poses are stamped at most so much too early or too late. Chosen: a pose that is later than that is of no use."""
    delay_step_s: float = 0.02
    """The delay of poses is scanned in steps of this. Chosen: between them a parabola is exact enough to begin with."""
    lags_s: tuple[float, ...] = (0.02, 0.04, 0.06, 0.09, 0.13, 0.18, 0.25, 0.35, 0.5, 0.7, 1.0)
    """Lags behind which the delay of commands is scanned. Chosen: as close as the delay can tell them apart."""
    lag_reach_s: float = 0.15
    """So far about the delay that is as long in all. Chosen: a lag is not quite as late as a delay of its length."""
    most_command_pairs: int = 3000
    """About so many pairs of samples are compared in it at most. Chosen: more say no more, and take longer."""
    delay_span_s: float = 0.4
    """Turns and ways between poses so far apart are compared with the wheels'. Chosen: several poses of a lidar."""
    clock_stretch_s: float = 12.0
    """A drift or jump of the poses' clock is looked for in stretches of this. Chosen: each with starts and turns."""
    least_clock_share: float = 0.5
    """Not where those that show a delay lie in less of the log. Chosen: a line through them says little of the rest."""
    clock_outlier_s: float = 0.1
    """A stretch further off than this counts as so far. Chosen: wheels that begin a circle slowly look late by more."""
    clock_times_better: float = 2.0
    """It explains so many times more of how the stretches' delays scatter than it leaves. Chosen."""
    least_clock_error_s: float = 0.03
    """A smaller one is none. Chosen: a pose of a robot that turns at 1 rad/s is then off by its usual noise."""
    least_clock_nats: float = 0.02
    """And the whole log fits by so much per pose better with it. Measured: drifting clocks 0.04 to 0.8."""
    least_link_error_s: float = 0.15
    """Of commands a smaller one is none. Measured: lags that differ from turn to turn make 0.05 of an even link, and a
    drive that ramps by 9 rad/s^2 makes 0.105."""
    least_delay_nats: float = 0.05
    """A delay, and a drift or jump of the commands' clock, stands out by so much per pose or pair. Measured: delays on
    steady circles 0.4, of a robot that turns about 3; even links 0.046 at most."""


@dataclass(frozen=True, slots=True)
class NoiseSettings:
    """The noise of wheels, body and poses, learnt from the log itself."""

    by_stamps_share: float = 0.5
    """Poses as they are stamped begin the search in place of those as late as at first sight, where they leave so small
    a share of the misfit. Chosen: what is late by little fits alike, and first sight that errs by 0.3 s far worse."""
    shortest_window: int = 12
    """Windows with fewer poses are left out, unless most are so thin. Chosen."""
    slip_onset_m_s: float = 0.05
    """From this rim speed on the body slips as much as it ever does. Chosen."""
    trusted_wheel_blocks: float = 1.0
    """How far the wheels' noise model is believed before a log speaks, in blocks of time. Measured: the mean square of
    scores of what is not there is 3.4 over six dirty logs."""
    trusted_body_blocks: float = 6.0
    """The same for the body, whose noise wanders less. Measured: 1.4 over six dirty logs."""
    calm_s: float = 0.05
    """Half the span over which measured speeds are averaged for the quick error. Chosen."""
    fewest_steady: int = 3
    """At least so many samples either side then. Chosen."""
    huber: float = 3.0
    """Whitened residuals beyond grow linearly. Literature: Huber's loss (1964); the size is chosen."""
    steady_s: float = 0.3
    """Half the span over which speeds are averaged where there is no model to say what to expect, and over which errors
    that are alike at every speed are measured. Chosen: several readings."""
    even_huber: float = 1.345
    """Of them those beyond so many times their size grow linearly. Literature: 95 % efficient (Huber, 1964)."""
    prior_sd: float = 2.0
    """Standard deviation of the logarithm of every noise parameter about its start. Chosen: a factor of seven."""
    difference_step: float = 2e-2
    """Step of the logarithms in central differences. Chosen."""
    wheel_iterations: int = 25
    """Steps of the search for the wheels' noise at most. Chosen: it is flat by then."""
    outlier: float = 5.0
    """Poses beyond so many standard deviations are left out, differences of samples count as that much. Chosen: one in
    two million by chance."""
    poor_fit: float = 1.5
    """Mean square of whitened residuals from which on a fit or a regime disagrees, plainer noise is assumed, and a
    stretch is weighed down. Chosen: noise alone has one."""
    smooth_samples: int = 25
    """The local size of residuals is a mean over so many samples either side. Chosen."""
    command_jitter_ratio: float = 2.0
    """Commands scatter by so many times what the encoder's stamps scatter. Chosen."""
    command_jitter_share: float = 0.1
    """And by this share of the encoder's period. Chosen. More than both is a response, and no jitter."""
    largest_wheel_noise: tuple[float, ...] = (0.05, 1.0, 0.1, 0.05, 0.1, 0.1, 0.02)
    """Upper bounds in the order of `WheelNoise`. Chosen: beyond, wheels that do not turn would pass for noise."""


@dataclass(frozen=True, slots=True)
class FitSettings:
    """Least squares, and the richest model of a channel, whose residual is noise."""

    iterations: int = 12
    """Steps of a fit at most. Chosen: nearly all end before."""
    enough_nats: float = 0.02
    """A step that gains less is the last one. Chosen."""
    promised_share: float = 0.25
    """Of fits that only compete, a step that gains what was promised within this share takes the derivatives along.
    Chosen: the next step then errs by about its square."""
    least_known_share: float = 1e-3
    """A part of a log with less of the information about a parameter says nothing of it. Chosen."""
    part_known_share: float = 0.2
    """A part of a log, or a regime, says nothing of a parameter of which it has less of its share of the information.
    Chosen."""
    ridge: float = 1e-2
    """Ridge of the richest model, on columns of unit length. Chosen: columns that look alike stay small."""
    rounds: int = 2
    """How often the noise, or the weight of errors, is learnt anew from what a fit leaves. Chosen: it is settled by
    then."""
    richest_halvings: int = 4
    """How often its step is halved until it fits better. Chosen."""
    bend_shares: tuple[float, ...] = (0.02, 0.05, 0.1, 0.2, 0.35, 0.55, 0.75, 0.9)
    """Where the static response of a wheel may bend, shares of the largest command. Chosen: denser below."""
    responses_s: tuple[float, ...] = (0.02, 0.05, 0.12, 0.3)
    """Time constants of further responses. Chosen: factors of two and a half."""
    slews_s: tuple[float, ...] = (0.1, 0.2, 0.35, 0.5, 0.7, 1.0, 1.4, 2.0)
    """How long wheels may take to the largest command where their change is limited. Chosen."""


@dataclass(frozen=True, slots=True)
class SelectionSettings:
    """Which effects are accepted."""

    most_moved_share: float = 0.1
    """It is judged where it moves most, on this share of the predictions. Chosen: some are felt in few places only."""
    least_moved_m: float = 1e-3
    """What moves predictions less is not worth a name. Chosen: below what poses are measured to."""
    named_score: float = 4.0
    """Score that a named effect takes at least. Measured: of one parameter it takes twice the gain 13, by chance in one
    log of 3700, of about 18 names in one of 200."""
    unnamed_score: float = 20.0
    """Score that a term without a name takes at least, and a name before the noise is learnt. Measured: with both
    scores, nothing was named in 446 of 450 logs with nothing hidden."""
    heaviest: float = 1.5
    """Scores are raised by up to this factor where the noise has heavy tails. Chosen: noise in bursts wanders too, more
    slowly than any block could show."""
    clipped_at: float = 6.0
    """Whitened residuals beyond do not raise it further. Chosen."""
    silent: float = 1e-3
    """Whitened residuals below come of samples that say nothing. Chosen."""
    profile_searches: int = 4
    """Rounds of the closer search of a profiled entry. Chosen."""
    large_share: float = 0.25
    """An effect that makes up this share of what such a fit lacks is taken whatever its score. Chosen."""
    telling_nats: float = 3.0
    """One of two explanations is told, or takes the place of the other, if it is better by this. Literature: half a
    difference of BIC of 6, positive evidence (Kass and Raftery, 1995)."""
    block_lengths: tuple[int, ...] = (1, 3, 9)
    """Neighbouring blocks taken as one for the sandwich variance. Chosen: 3, 9 and 27 s."""
    sure_sigmas: float = 3.0
    """What differs by so many standard deviations is no chance: parts of a log, logs, regimes and their noise, the two
    channels' opinions of an encoder. Chosen: one in 370."""
    clearly_closer: float = 0.7
    """Such a fit is told where its deviations, in the geometric mean, are so many times those of the other. Chosen:
    less may be chance."""
    fewest_blocks: int = 5
    """Fewer blocks say nothing about their scatter. Chosen."""


@dataclass(frozen=True, slots=True)
class TermSettings:
    """Unnamed terms, and patches of the floor."""

    most_terms: int = 3
    """More terms are not added. Chosen."""
    least_independent_share: float = 0.1
    """A term of which what is fitted already does the rest is left out: it would only pull against it. Chosen."""
    worth_trying_nats: float = 18.0
    """Gain to first order from which on a term is fitted. Chosen: below what acceptance takes."""
    most_tried: int = 4
    """So many of the most promising terms are fitted until one is accepted. Chosen: what promises most to first order
    may gain nothing, and the next all of it."""
    waves: int = 8
    """How many cosines of the time ground may vary by, the slowest. Chosen: of 150 s, down to a period of 37 s."""
    usual_wave: float = 0.1
    """Standard deviation that is expected of each, as a share of the speed. Chosen."""
    smooth_nodes: int = 8
    """Accelerations are taken of speeds over so many nodes either side. Chosen: a tenth of a second."""
    disc_radii_m: tuple[float, ...] = (0.5, 0.75, 1.0, 1.3)
    """Sizes of patches. Chosen."""
    disc_spacing_m: float = 0.4
    """Distance of the centres that are tried. Chosen: half a patch."""
    disc_size_steps_m: tuple[float, ...] = (-0.15, -0.05, 0.0, 0.05, 0.15)
    """And of the radius. Chosen."""
    least_inside: float = 0.03
    """Share of all turning that must lie inside a patch. Chosen."""
    most_inside: float = 0.8
    """And at most. Chosen: outside of it the floor must be known too."""
    largest_floor_m2: float = 60.0
    """On larger floors no patch is sought. Chosen: there would be too many."""


@dataclass(frozen=True, slots=True)
class Folds:
    """Division of a log into folds, each predicted from the others: every `count`-th stretch belongs to one fold."""

    stretch_s: float
    count: int


@dataclass(frozen=True, slots=True)
class PredictionSettings:
    """Free-running predictions on data that was not fitted."""

    horizons_s: tuple[float, ...] = (0.5, 1.0, 2.0, 5.0)
    """How far ahead. Chosen."""
    reported_horizon_s: float = 2.0
    """The one that the answer is about, or the longest below that runs are long enough for. Chosen: about as far as a
    planner looks."""
    folds: Folds = Folds(21.0, 2)
    """Stretches that are left out in turn. Chosen: of seven blocks, longer than `DRIFT_S`."""
    short_folds: Folds = Folds(9.0, 4)
    """Those of logs shorter than six of these stretches, as half of a minute's log is too little to learn from. Chosen
    on halves of twelve logs of a small robot; learnt from thirds of 15 logs of three robots, so
    divided 7 of 90 offered models were worse than `timed`, and 10 as longer logs are; better by a fifth 15 either way.
    """
    pose_reach_s: float = 0.3
    """A start pose is averaged over so long either side. Chosen."""
    fixed_sigmas: float = 5.0
    """A value that the other folds fix to so many standard deviations is used, however few its data. Chosen."""
    resamples: int = 400
    """Bootstrap draws of an interval. Chosen."""
    rough_geometry: float = 0.1
    """Without effects the geometry of the whole chain is that of the body within this share. Chosen."""
    joint_trust: float = 3.0
    """Before the whole chain is fitted, channels are trusted to so many of their standard deviations. Measured: halves
    of real logs predict each other best with 3 to 10."""
    delay_far_s: float = 0.2
    """Where `timed` has a delay or a lag so far from that of the wheels' channel, the last fit begins from either.
    Chosen: a ramp of seconds makes a lag of a second, and a fit that begins there ends there."""
    worse: float = 1.05
    """A larger ratio of errors is worse. Measured: equally good models scatter by some percent."""
    standing_m_s: float = 0.02
    """Mean speed below which the robot stands; three times this, turns on the spot. Chosen."""
    spinning_rad_s: float = 0.1
    """Mean yaw rate above which it turns on the spot, and below which it stands. Chosen."""
    turning_rad_s: float = 0.3
    """Mean yaw rate above which it drives a curve. Chosen."""
    speeding_m_s2: float = 0.25
    """Mean acceleration above which it speeds up or brakes. Chosen."""


@dataclass(frozen=True, slots=True)
class ReportSettings:
    """Settings of the report on remaining disagreements and on effects that a log could not show."""

    proved_claims: int = 3
    """So many claims of what a log shows are proved by putting the effect in. Chosen: each takes a search or two."""
    speeding_rad_s2: float = 2.0
    """Growth of the wheels' speed from which on they speed up or brake. Chosen."""
    most_listed: int = 3
    """So many regimes, the loudest, and names are listed at most. Chosen."""
    end_share: float = 0.01
    """Commands that come early or late by this close to the most that is plausible do so by more. Chosen."""
    wide_share: float = 0.5
    """A value whose half interval, or whose change from one regime to its opposite, is over so much of its distance
    from none says too little. Chosen: nobody who is told the value expects it."""
    limit_share: float = 0.75
    """So near a limit it shows: where this share of what the robot can do is asked, and where an interval is no wider
    than from it to there. Chosen."""
    beyond_s: float = 0.5
    """For so long in all at least. Chosen."""
    form_apart_sigmas: float = 3.5
    """By so many standard deviations. Chosen: of some twenty comparisons in a log one in a hundred logs by chance."""
    worth_share: float = 0.1
    """A value that changes by less of itself is the same to whoever drives; a name that takes less of what its channel
    lacks, where it still disagrees, is disputed. Chosen."""
    differ_share: float = 0.03
    """Logs of one robot differ in its geometry by so much of it at least. Chosen: another floor changes more."""
    event_span_s: tuple[float, float] = (0.2, 2.0)
    """Rare events last so long at least and at most. Chosen: twice a slow controller's period, and what a window of
    poses can hold."""
    event_chance: float = 0.01
    """Share of logs without a rare event in which chance makes one. Chosen: as effects are named by chance."""


@dataclass(frozen=True, slots=True)
class GapSettings:
    """All settings of the analysis; every figure of the documentation was made with the defaults."""

    grid: GridSettings = GridSettings()
    noise: NoiseSettings = NoiseSettings()
    fit: FitSettings = FitSettings()
    selection: SelectionSettings = SelectionSettings()
    terms: TermSettings = TermSettings()
    prediction: PredictionSettings = PredictionSettings()
    report: ReportSettings = ReportSettings()


DEFAULT_SETTINGS = GapSettings()
