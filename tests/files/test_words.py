"""Whatever field of robot.toml or of a model has a fixed set of values, a wrong one is told all of them."""

from __future__ import annotations

import pytest
from msgspec import inspect

from disco_hw.config import RobotConfig, load_robot_config
from disco_hw.errors import InputError
from disco_hw.files import nearest
from disco_hw.model import load_model
from drivers.motor import motor_drivers
from tests.config.test_robot import GOOD

MODEL = "format = 1\n[base]\nwheel_radius_m = 0.06\naxial_distance_m = 0.4\n"


DRIVERS = ("link", "driver", tuple(motor_drivers()))


def fields_with_choices(kind):
    """Section, field and values of every field that has a fixed set of them."""
    for section in inspect.type_info(kind).fields:
        for one in section.type.types if isinstance(section.type, inspect.UnionType) else (section.type,):
            if isinstance(one, inspect.LiteralType):
                yield "", section.name, one.values
            if isinstance(one, inspect.StructType):
                for field in one.fields:
                    if isinstance(field.type, inspect.LiteralType):
                        yield section.name, field.name, field.type.values


def refusal(load, path, text):
    path.write_text(text)
    with pytest.raises(InputError) as refused:
        load(path)
    assert "\n" not in str(refused.value)
    return str(refused.value)


def test_there_are_such_fields():
    found = {(section, field) for section, field, _ in fields_with_choices(RobotConfig)}
    assert found >= {("link", "kind"), ("control", "mode"), ("control", "uncertainty")}


@pytest.mark.parametrize("wrong", ['"usb"', "7", "[]"])
@pytest.mark.parametrize(("section", "field", "values"), [*fields_with_choices(RobotConfig), DRIVERS])
def test_every_choice_of_robot_toml_is_listed(tmp_path, section, field, values, wrong):
    message = refusal(load_robot_config, tmp_path / "robot.toml", GOOD + f"[{section}]\n{field} = {wrong}\n")
    assert f"{section}.{field}: " in message
    assert all(str(value) in message.partition("; ")[2] for value in values)


def test_the_kinds_of_task_and_belief_are_listed(tmp_path):
    message = refusal(load_robot_config, tmp_path / "robot.toml", GOOD + '[task]\nkind = "square"\n')
    assert "task.kind: 'square' is not a kind of task; write one of circle, " in message
    message = refusal(load_model, tmp_path / "model.toml", MODEL + '[belief]\nkind = "cauchy"\nnames = []\n')
    assert "belief.kind: invalid value 'cauchy'; write one of gaussian, mixture, uniform" in message
    message = refusal(load_model, tmp_path / "model.toml", MODEL + "[belief]\nnames = []\n")
    assert "[belief] kind: missing; add it: one of gaussian, mixture, uniform" in message
    assert "format: invalid enum value 2; write 1" in refusal(
        load_model, tmp_path / "model.toml", MODEL.replace("1", "2")
    )


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (
            GOOD.replace("wheel_radius_m", "weel_radius"),
            "[robot] weel_radius: no such field; did you mean wheel_radius_m?",
        ),
        (GOOD.replace("[robot]", "[robott]"), "robott: no such field; did you mean robot?"),
        (GOOD + '[link]\nchanel = "can0"\n', "[link] chanel: no such field; did you mean channel?"),
        (GOOD + "[task]\nradius = 1.0\n", "[task] radius: no such field; did you mean radius_m?"),
        (GOOD + "[control]\nzzz = 1.0\n", "[control] zzz: no such field; check the spelling or remove it"),
    ],
)
def test_a_misspelt_name_gets_the_nearest(tmp_path, text, expected):
    assert expected in refusal(load_robot_config, tmp_path / "robot.toml", text)


def test_a_misspelt_name_of_a_model_gets_the_nearest(tmp_path):
    message = refusal(load_model, tmp_path / "model.toml", MODEL.replace("axial_distance_m", "axle_distance_m"))
    assert "did you mean axial_distance_m?" in message
    message = refusal(load_model, tmp_path / "model.toml", MODEL + '[[effects]]\nname = "motor_lagg"\ntau_s = 0.1\n')
    assert "did you mean motor_lag?" in message
    assert nearest("zzz", ["abc"]) is None


def test_a_field_of_another_kind_of_belief_is_no_misspelling_of_itself(tmp_path):
    text = MODEL + '[belief]\nkind = "uniform"\nnames = []\nmean = []\n'
    assert '[belief] mean: belongs to the kind "gaussian"; write kind = "gaussian", or remove it' in refusal(
        load_model, tmp_path / "model.toml", text
    )


def test_values_in_lists_have_their_place(tmp_path):
    message = refusal(load_model, tmp_path / "model.toml", MODEL + '[belief]\nkind = "gaussian"\nnames = [1]\n')
    assert "belief.names[0]: expected `str`, got `int`; correct the value" in message
