import pytest

from disco_hw.errors import InputError
from disco_hw.viewer.recording import Recording, stage_of_robot
from tests.runtime.simulated import write_ticks
from tools.viewer_run import MODEL_FILE, ROBOT_FILE, plan_at, pose_at, tick_records


def test_a_log_is_shown_as_it_was_recorded(recording, timeline):
    assert recording.stage.name == "wombot"
    assert recording.stage.model.belief is not None
    assert recording.duration_s == pytest.approx(3.98)
    assert len(recording.ticks) == 200
    shot = recording.at(1.0)
    assert shot.pose == pytest.approx(pose_at(50))
    assert shot.plan == plan_at(50)
    for name in ("estimate", "wheels", "command", "pose", "innovation", "planner", "loop", "power"):
        got, expected = getattr(recording.timeline, name), getattr(timeline, name)
        assert got.rows(0, 1 << 62)[1].tolist() == expected.rows(0, 1 << 62)[1].tolist(), name


@pytest.mark.parametrize(
    ("t_s", "tick"), [(-5.0, 0), (0.0, 0), (0.0199, 0), (0.02, 1), (0.03, 1), (3.98, 199), (99.0, 199)]
)
def test_an_instant_is_that_of_the_tick_before(recording, t_s, tick):
    assert recording.tick_at(t_s) == tick
    assert recording.at(t_s).pose == pytest.approx(pose_at(tick))
    assert recording.seconds_of(tick) == pytest.approx(0.02 * tick)


def test_a_log_without_its_robot_needs_one(tmp_path):
    bare = write_ticks(tmp_path / "bare.mcap", [tick_records(0)])
    with pytest.raises(InputError, match="--robot"):
        Recording(bare)
    with Recording(bare, ROBOT_FILE) as opened:
        assert opened.stage.name == "wombot"
        assert opened.duration_s == 0.0


def test_a_log_without_estimates_is_told(tmp_path):
    with pytest.raises(InputError, match="no estimates"):
        Recording(write_ticks(tmp_path / "empty.mcap", [(1, tick_records(0)[1][:2])]), ROBOT_FILE)


def test_what_is_no_log_is_told(tmp_path):
    with pytest.raises(InputError):
        Recording(tmp_path / "missing.mcap")
    with pytest.raises(InputError):
        Recording(ROBOT_FILE)


def test_the_stage_is_that_of_the_robot_file_and_its_model():
    stage = stage_of_robot(ROBOT_FILE)
    assert (stage.name, stage.task.radius_m, stage.wheel_radius_m) == ("wombot", 0.75, 0.06)
    assert stage.x_icr_m == 0.238, "the model's, not the nominal one"


def test_the_stage_knows_which_end_of_the_robot_goes_ahead(tmp_path):
    robot = tmp_path / "robot.toml"
    text = ROBOT_FILE.read_text("utf-8").replace('file = "wombot_model.toml"', f'file = "{MODEL_FILE}"')
    for facing in ("forwards", "backwards"):
        robot.write_text(text.replace("[control]\n", f'[control]\nfacing = "{facing}"\n'), "utf-8")
        assert stage_of_robot(robot).drives_backwards is (facing == "backwards")


def test_a_log_brings_both_files(recording):
    expected = stage_of_robot(ROBOT_FILE, MODEL_FILE)
    assert recording.stage.task == expected.task
    assert recording.stage.model.belief.mean().tolist() == expected.model.belief.mean().tolist()


def test_a_robot_file_that_is_none_is_told(tmp_path):
    with pytest.raises(InputError, match=r"none\.toml"):
        stage_of_robot(tmp_path / "none.toml")
