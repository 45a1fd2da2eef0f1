"""A driver behind a wiring: what is asked of a real side reaches the motor that turns it, and comes back from it."""

from __future__ import annotations

import itertools
from dataclasses import replace

import pytest

from drivers.motor import AS_CONFIGURED, Wiring, create_driver, rewired
from drivers.types import DriverState, Limit, Limits, MotorSample, Readings, WheelCommand, WheelSample


class Miswired:
    """A controller whose own sides answer as `wiring` says: it turns as commanded, and reports what it turns."""

    state, detail = DriverState.ARMED, "a test's"

    def __init__(self, wiring):
        self.wiring, self.true = wiring, (0.0, 0.0)

    def transmit(self, now_ns, command):
        wheel_speeds = (command.left_rad_s, command.right_rad_s)
        sides = wheel_speeds[::-1] if self.wiring.sides_swapped else wheel_speeds
        self.true = tuple(
            direction * speed * self.wiring.turn_ratio
            for direction, speed in zip(self.wiring.motor_direction, sides, strict=True)
        )
        return ()

    def receive(self, now_ns, frames):
        on = [d * s / self.wiring.turn_ratio for d, s in zip(self.wiring.encoder_direction, self.true, strict=True)]
        if self.wiring.sides_swapped != self.wiring.encoders_swapped:
            on.reverse()
        return Readings(
            wheels=(WheelSample(1, 2, 10.0 * on[0], 10.0 * on[1], *on),), motors=(MotorSample(1, 2, 3, 4, 5),)
        )


def every_wiring():
    flags, signs = (False, True), list(itertools.product((1, -1), repeat=2))
    for swapped, crossed, motors, encoders in itertools.product(flags, flags, signs, signs):
        yield Wiring(
            sides_swapped=swapped,
            encoders_swapped=crossed,
            motor_direction=motors,
            encoder_direction=encoders,
            turn_ratio=2.5,
        )


@pytest.mark.parametrize("wiring", list(every_wiring()), ids=str)
def test_whatever_the_wiring_the_wheels_do_what_is_asked_and_say_what_they_do(wiring):
    controller = Miswired(wiring)
    driver = rewired(controller, wiring)
    driver.transmit(0, WheelCommand(0.5, -0.3, 0.1))
    (reported,) = driver.receive(0, ()).wheels
    assert controller.true == pytest.approx((0.5, -0.3))
    assert (reported.left_speed_rad_s, reported.right_speed_rad_s) == pytest.approx((0.5, -0.3))
    assert (reported.left_angle_rad, reported.right_angle_rad) == pytest.approx((5.0, -3.0))


def test_limits_are_those_of_the_true_wheels_and_nobody_s_stay_nobody_s():
    controller = Miswired(Wiring(turn_ratio=0.25))
    controller.limits = Limits(
        max_wheel_speed_rad_s=Limit(24.0, "controller"),
        command_timeout_s=Limit(0.1, "robot.toml"),
        stop_deceleration_rad_s2=Limit(10.0, "robot.toml"),
        ticks_per_rev=Limit(4096.0, "controller"),
    )
    assert rewired(controller, controller.wiring).limits == replace(
        controller.limits,
        max_wheel_speed_rad_s=Limit(6.0, "controller"),
        stop_deceleration_rad_s2=Limit(2.5, "robot.toml"),
    )
    controller.limits = None
    assert rewired(controller, controller.wiring).limits is None


def test_currents_change_sides_with_the_motors():
    reported = rewired(Miswired(Wiring(sides_swapped=True)), Wiring(sides_swapped=True)).receive(0, ()).motors[0]
    assert (reported.left_current_a, reported.right_current_a) == (3, 2)
    assert (reported.left_temperature_c, reported.right_temperature_c) == (5, 4)


def test_without_a_wiring_the_driver_stays_itself():
    driver = create_driver(None)
    assert rewired(driver, AS_CONFIGURED) is driver
    assert rewired(driver, Wiring(sides_swapped=True)).state is DriverState.DISCONNECTED
