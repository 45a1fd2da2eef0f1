import pytest

from disco_hw.errors import InputError
from disco_hw.viewer.recording import Recording, stage_of_robot
from tools.viewer_run import MODEL_FILE, ROBOT_FILE


def test_the_robot_file_and_its_model():
    stage = stage_of_robot(ROBOT_FILE)
    assert (stage.name, stage.task.radius_m, stage.wheel_radius_m) == ("wombot", 0.75, 0.06)
    assert stage.x_icr_m == 0.238, "the model's, not the nominal one"


def test_a_log_brings_both_files(log_file):
    with Recording(log_file) as recording:
        stage = recording.stage
    expected = stage_of_robot(ROBOT_FILE, MODEL_FILE)
    assert stage.task == expected.task
    assert stage.model.belief.mean().tolist() == expected.model.belief.mean().tolist()


def test_a_file_that_is_none_is_told(tmp_path):
    with pytest.raises(InputError, match=r"none\.toml"):
        stage_of_robot(tmp_path / "none.toml")
