"""The page's e-stop stops a driving robot while another user of the machine holds 4000 connections to the page."""

import time

import pytest

from tests.hil.stack import STATIONARY_RAD_S
from tests.viewer.test_attack import attack, limited_page
from tests.viewer.test_operator_controls import line_to, request_reply
from tools.stack import running_stack

pytestmark = pytest.mark.hil
ATTACKED_S = 5.0


@pytest.mark.parametrize(
    "descriptors", [pytest.param(256, marks=pytest.mark.thorough), pytest.param(1024, marks=pytest.mark.long)]
)
def test_a_press_during_an_attack_latches_the_stop_and_the_wheels_stand(tmp_path, descriptors):
    output_file = tmp_path / "page.txt"
    with running_stack(tmp_path) as stack, limited_page(stack.robot_file, output_file, descriptors) as port:
        with line_to(port) as line:
            stack.drive()
            with attack(port):
                time.sleep(ATTACKED_S)
                pressed_s = time.monotonic()
                reply = request_reply(line, do="estop")
                replied_s = time.monotonic()
                status = stack.operator.wait_until("ESTOP", lambda status: status["robot_state"] == "ESTOP", 10.0)
                latched_s = time.monotonic()
                stack.operator.wait_for_standstill(10.0)
                # Still latched while the attack goes on.
                assert stack.operator.status()["robot_state"] == "ESTOP"
        assert status["estop"]
        rows = stack.truth()
    print(f"press to reply {replied_s - pressed_s:.3f} s, to latched {latched_s - pressed_s:.3f} s")
    assert "NOT SENT" not in str(reply)
    before = [row for row in rows if pressed_s - 0.3 < row.t_s < pressed_s]
    assert max(row.fastest for row in before) > 5.0, "the robot did not drive when the button was pressed"
    latch_s = next(row.t_s for row in rows if row.state == "ESTOP")
    print(f"press to ESTOP in the robot {latch_s - pressed_s:.3f} s")
    assert latch_s > pressed_s
    assert rows[-1].state == "ESTOP"
    assert rows[-1].fastest < STATIONARY_RAD_S
