"""Free run: the model from a known state through given commands, in the precision of its arrays."""

from __future__ import annotations

import math
from typing import Any

from disco_hw.model.effects import command_delay
from disco_hw.model.jit import kernel_function
from disco_hw.model.step import body_velocity, move, wheel_step
from disco_hw.model.tables import base_point, effect_point


@kernel_function
def free_run(states: Any, commands: Any, history: int, point: int, base: Any, effects: Any, integration: Any) -> None:
    """Run the model from `states[0]`; writes `states[1:]`.

    `states` (N + 1, 5): x, y, yaw (not wrapped), left and right wheel speed. `commands` (history + N, 2) rad/s, held
    over one step each; the first `history` rows are what was commanded before. `base`, `effects`: coefficient tables
    of which row `point` is used.
    """
    here, effects_here = base_point(base, point), effect_point(effects, point)
    x, y, yaw = states[0, 0], states[0, 1], states[0, 2]
    wheel_left, wheel_right = states[0, 3], states[0, 4]
    cos_yaw, sin_yaw = math.cos(yaw), math.sin(yaw)
    axle_x = x + here.x_icr_m * cos_yaw
    axle_y = y + here.x_icr_m * sin_yaw
    late = history - command_delay.whole_steps(effects_here.command_delay)
    for t in range(states.shape[0] - 1):
        recent, older = max(t + late, 0), max(t + late - 1, 0)
        left = command_delay.blend(commands[recent, 0], commands[older, 0], effects_here.command_delay)
        right = command_delay.blend(commands[recent, 1], commands[older, 1], effects_here.command_delay)
        wheel_left, wheel_right, mean_left, mean_right = wheel_step(left, right, wheel_left, wheel_right, effects_here)
        forward, lateral, turn = body_velocity(mean_left, mean_right, here, effects_here)
        axle_x, axle_y, cos_yaw, sin_yaw = move(axle_x, axle_y, cos_yaw, sin_yaw, forward, lateral, turn, integration)
        yaw = yaw + (turn + turn) * integration.step_s
        states[t + 1, 0] = axle_x - here.x_icr_m * cos_yaw
        states[t + 1, 1] = axle_y - here.x_icr_m * sin_yaw
        states[t + 1, 2] = yaw
        states[t + 1, 3] = wheel_left
        states[t + 1, 4] = wheel_right
