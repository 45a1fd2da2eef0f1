"""A log replays bit for bit, and a changed robot shows at the first tick and field that differ."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from msgspec import structs

from disco_hw.config import SHIPPED_ROBOT
from disco_hw.control.optimiser import Optimiser
from disco_hw.control.past_motion import DriveMeans
from disco_hw.control.plan import DISTURBANCE_UNTIL_VERSION, PLANNER_VERSION
from disco_hw.errors import InputError
from disco_hw.log import MODEL_TOML, ROBOT_TOML, Attachment
from disco_hw.log.reader import open_log
from disco_hw.log.records import STATES, Command, Plan
from disco_hw.model import EffectSetting, load_model, save_model
from disco_hw.runtime.pipeline import Source
from disco_hw.runtime.replay import replay
from disco_hw.runtime.supervisor import UserRequest
from tests.runtime.simulated import ROBOT_TEXT, arm, replayed, simulated_stack, start, write_ticks
from tests.tables import thinned

ROBOTS = SHIPPED_ROBOT.parent


@pytest.fixture(scope="module")
def ticks():
    """The records of the daemon for a start, two seconds of driving and a stop."""
    stack = simulated_stack()
    start(stack, 2.0)
    stack.run(1.0, UserRequest.DISARM)
    return stack.recorder.ticks


def write_log(
    path: Path,
    ticks,
    robot: str | None = None,
    model: str | None = None,
    **how,
) -> Path:
    texts = {
        ROBOT_TOML: robot or (ROBOTS / "wombot.toml").read_text(),
        MODEL_TOML: model or (ROBOTS / "wombot_model.toml").read_text(),
    }
    attachments = [Attachment(name, "application/toml", text.encode()) for name, text in texts.items()]
    return write_ticks(path, ticks, attachments, **how)


def test_the_same_robot_gives_the_same_bits(tmp_path, ticks):
    report = replayed(write_log(tmp_path / "run.mcap", ticks))
    assert report.ticks == len(ticks)
    assert report.values > 5000


@pytest.mark.thorough
def test_a_drive_whose_model_remembers_replays_bit_for_bit(tmp_path, monkeypatch):
    model = load_model(ROBOTS / "wombot_model.toml")
    terms = {"command += k sign(u - mean_1s(u))": -0.2, "omega += k (omega - mean_1s(omega))": -0.3}
    model = replace(model, effects=tuple(EffectSetting(name, {"k": k}) for name, k in terms.items()))
    save_model(model, tmp_path / "model.toml")
    text = (ROBOTS / "wombot.toml").read_text().replace("wombot_model.toml", "model.toml")
    (tmp_path / "robot.toml").write_text(text)
    stack = simulated_stack(robot_file=tmp_path / "robot.toml")
    arm(stack)
    # Longer than commands are kept one by one.
    stack.run(3.0, UserRequest.START)
    ticks = stack.recorder.ticks
    log = write_log(tmp_path / "run.mcap", ticks, text, (tmp_path / "model.toml").read_text())
    replayed(log)
    for method in ("add_command", "add_wheels"):
        with monkeypatch.context() as patch:
            patch.setattr(DriveMeans, method, lambda *_: None)
            assert not replay(log).ok


@pytest.mark.thorough
def test_a_follower_takes_over_from_a_planner_that_finds_nothing_and_replays_bit_for_bit(tmp_path, monkeypatch):
    step = Optimiser.step

    def failing(self, *arguments):
        valid = step(self, *arguments)
        return valid and not 60 <= self.step_number < 260

    monkeypatch.setattr(Optimiser, "step", failing)
    text = ROBOT_TEXT.replace("rate_hz = 50.0", 'rate_hz = 50.0\nfallback = "lqr"')
    (tmp_path / "robot.toml").write_text(text)
    stack = simulated_stack(robot_file=tmp_path / "robot.toml")
    driven = start(stack, 3.0)
    sources = [tick.pipeline.source for tick in driven]
    first, last = sources.index(Source.FALLBACK), len(sources) - sources[::-1].index(Source.FALLBACK)
    assert set(sources[first:last]) == {Source.FALLBACK}
    assert last - first > 40
    assert sources[last:] == [Source.PLAN] * (len(sources) - last) != []
    assert all(tick.command.left_rad_s > 0.5 for tick in driven[first:last])
    events = [text for tick in driven for text in tick.events if text.startswith("planner")]
    assert events == [
        "planner: no valid plan; the fallback controller lqr follows the line instead",
        "planner: valid plan again; the planner drives",
    ]
    log = write_log(tmp_path / "run.mcap", stack.recorder.ticks, text)
    replayed(log)
    other = write_log(tmp_path / "other.mcap", stack.recorder.ticks, text.replace('"lqr"', '"kanayama"'))
    assert not replay(other).ok


@thinned(
    ("file", "old", "new", "field"),
    [
        ("model", "wheel_radius_m = 0.061", "wheel_radius_m = 0.0611", "Plan."),
        ("robot", "rate_hz = 50.0", "rate_hz = 50.0\nseed = 2", "Plan."),
        ("robot", "max_wheel_acceleration_rad_s2 = 20.0", "max_wheel_acceleration_rad_s2 = 10.0", ""),
        ("robot", "[log]", "[estimation]\nslip_std_m_per_sqrt_m = 0.021\n[log]", "Estimate."),
    ],
    quick=1,
)
def test_another_robot_shows_where_it_first_differs(tmp_path, ticks, file, old, new, field):
    text = (ROBOTS / ("wombot.toml" if file == "robot" else "wombot_model.toml")).read_text()
    assert old in text
    changed = {file: text.replace(old, new, 1)}
    if file == "model":
        # The belief's mean, which the estimator and the sigma points use.
        changed[file] = changed[file].replace("0.061", "0.0611")
    report = replay(write_log(tmp_path / "run.mcap", ticks, **changed))
    assert not report.ok
    assert report.difference.recorded != report.difference.replayed
    if file == "robot":
        assert report.difference.field.startswith(field)
    assert "first difference at tick" in report.as_text()


def altered(ticks, kind, change, at=None):
    """The ticks with another record of this kind, or without it for None: in one tick, or in all."""

    def records_of(records):
        changed = (change(record) if isinstance(record, kind) else record for record in records)
        return tuple(record for record in changed if record is not None)

    return [(t_ns, records_of(records) if at in (None, k) else records) for k, (t_ns, records) in enumerate(ticks)]


def test_one_changed_bit_in_the_log_is_found(tmp_path, ticks):
    changed = altered(ticks, Command, lambda one: structs.replace(one, left_rad_s=one.left_rad_s + 2.0**-40), at=150)
    report = replay(write_log(tmp_path / "run.mcap", changed))
    assert not report.ok
    assert (report.difference.field, report.difference.t_ns) == ("Command.left_rad_s", ticks[150][0])


def test_within_a_tolerance_a_plan_that_is_a_step_shorter_is_a_difference(tmp_path, ticks):
    changed = altered(ticks, Plan, lambda one: structs.replace(one, left_rad_s=one.left_rad_s[:-1]))
    assert replay(write_log(tmp_path / "run.mcap", changed), 1.0).difference.field == "Plan.left_rad_s"


def test_a_record_that_the_log_lacks_is_a_difference(tmp_path, ticks):
    changed = altered(ticks, Command, lambda _: None, at=150)
    found = replay(write_log(tmp_path / "run.mcap", changed)).difference
    assert (found.field, found.t_ns) == ("records", ticks[150][0])
    assert "Command" not in found.recorded
    assert "Command" in found.replayed


def test_plans_of_a_later_planner_are_refused_with_the_version_that_has_it(tmp_path, ticks):
    log = write_log(tmp_path / "later.mcap", ticks[:1], planner=PLANNER_VERSION + 1)
    text = f"{log}: its plans are of planner version {PLANNER_VERSION + 1}, .* up to {PLANNER_VERSION}; replay it with"
    with pytest.raises(InputError, match=text):
        replay(log)


def test_a_part_that_continues_another_is_refused_and_one_that_has_all_ticks_is_replayed(tmp_path, ticks):
    log = write_log(tmp_path / "run.part2.mcap", ticks[100:200], part=2, continues_sequence=100)
    with pytest.raises(InputError, match=rf"{log}: continues run\.mcap, and a replay needs .*; give the first part"):
        replay(log)
    # The first writer failed before it had a tick.
    assert replay(write_log(tmp_path / "all.mcap", ticks[:20], part=2, continues_sequence=0)).ok


def states_in_force(ticks):
    return tuple({type(one): one for _, records in ticks for one in records if type(one) in STATES}.values())


def test_all_parts_of_a_log_are_replayed_as_one_run(tmp_path, ticks):
    """A part begins with the states in force, which do not begin anew, and may repeat ticks that were not confirmed."""
    whole = replayed(write_log(tmp_path / "whole.mcap", ticks))
    write_log(tmp_path / "run.part2.mcap", ticks[100:150], part=2, continues_sequence=100)
    states = states_in_force(ticks[:145])
    write_log(tmp_path / "run.part4.mcap", ticks[145:], part=4, continues_sequence=145, states=states)
    # Of another run, and one that holds nothing.
    write_log(tmp_path / "run.part3.mcap", ticks[:20], part=3, continues_sequence=100, wall_offset_ns=5)
    (tmp_path / "run.part5.mcap").write_bytes(b"")
    report = replayed(write_log(tmp_path / "run.mcap", ticks[:110], continued=True))
    assert (report.ticks, report.values, report.missing_ticks) == (whole.ticks, whole.values, 0)
    assert report.parts == ("run.mcap", "run.part2.mcap", "run.part4.mcap")
    assert "3 parts" in report.as_text()


def test_a_replay_says_that_a_part_is_not_there(tmp_path, ticks):
    write_log(tmp_path / "run.part3.mcap", ticks[30:40], part=3, continues_sequence=30)
    report = replayed(write_log(tmp_path / "run.mcap", ticks[:20], continued=True))
    assert report.ticks == 20
    assert "run.mcap goes on in another part, which is not beside it and was not replayed" in report.as_text()


def test_plans_that_were_refined_otherwise_are_refused_and_a_log_without_plans_is_replayed(tmp_path, ticks):
    with pytest.raises(InputError, match="planner version 2, which refined them otherwise; replay it with disco-hw"):
        replay(write_log(tmp_path / "refined.mcap", ticks, planner=2))
    # Before that, plans were not refined at all: they are sampled again.
    assert replay(write_log(tmp_path / "sampled.mcap", ticks, planner=1)).difference.field.startswith("Plan.")
    planned = next(at for at, (_, records) in enumerate(ticks) if any(isinstance(one, Plan) for one in records))
    assert replay(write_log(tmp_path / "standing.mcap", ticks[:planned], planner=2)).ok


def test_a_log_without_ticks_or_robot_is_refused(tmp_path, ticks):
    with pytest.raises(InputError, match="holds no ticks"):
        replay(write_log(tmp_path / "empty.mcap", []))
    log = write_log(tmp_path / "damaged.mcap", ticks[:3])
    damaged = bytearray(log.read_bytes()[:-40])
    with open_log(log) as read:
        for chunk in read._contents.chunks:
            damaged[chunk.offset + 100] ^= 0xFF
    log.write_bytes(damaged)
    with pytest.raises(InputError, match=r"holds no ticks that can be read: at byte \d+: a chunk .* bytes are lost"):
        replay(log)
    with pytest.raises(InputError, match=r"carries no robot\.toml"):
        replay(write_ticks(tmp_path / "bare.mcap", ticks[:1]))
    odd = write_log(tmp_path / "odd.mcap", ticks[:1], model="format = 7\n")
    with pytest.raises(InputError, match=rf"^{odd}: model\.toml: format: "):
        replay(odd)


def test_a_drive_that_followed_a_disturbance_is_refused_and_one_that_did_not_is_replayed(tmp_path, ticks):
    text = (ROBOTS / "wombot.toml").read_text().replace("rate_hz = 50.0", "rate_hz = 50.0\ndisturbance = true")
    with pytest.raises(InputError, match=r"driven with control\.disturbance, which is followed no more; replay it"):
        replay(write_log(tmp_path / "old.mcap", ticks, text, planner=DISTURBANCE_UNTIL_VERSION))
    replayed(write_log(tmp_path / "new.mcap", ticks, text))
