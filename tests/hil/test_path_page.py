"""The live page of a robot that follows a path: it is drawn, its progress shown, and its speed alone can be changed."""

import pytest

from tests.hil.test_page import assert_visible, page_of
from tests.runtime.path_robot import ROBOTS
from tests.viewer.test_page import wait_for
from tools.browser import chromium, keep, opened
from tools.stack import running_stack

pytestmark = [pytest.mark.hil, pytest.mark.long, pytest.mark.browser]
TASK = 'path = "path.csv"\nspeed_m_s = 0.2\n'


@pytest.mark.timeout(300)
def test_a_path_is_drawn_its_speed_changed_and_a_reload_changes_nothing(tmp_path):
    (tmp_path / "path.csv").write_text((ROBOTS / "eight.csv").read_text())
    with chromium() as browser, running_stack(tmp_path, task=TASK, start=(1.5, 0.0, -1.5708)) as stack:
        output = tmp_path / "page.txt"
        with page_of(stack.robot_file, output) as (_, url), opened(browser, url, 900, 640) as tab:
            stack.operator.wait_for("READY", 60.0)
            frame = tab.frame_locator("#scene")
            frame.get_by_text("READY, no fault").wait_for(state="attached")
            assert_visible(tab, stack, empty_place=(0.75, 0.0))
            tab.get_by_role("button", name="Task…").click()
            tab.get_by_text("Follows path.csv").wait_for()
            for label, shown in (("Speed (m/s)", True), ("Radius (m)", False), ("Centre x (m)", False)):
                assert tab.get_by_label(label).is_visible() is shown, label
            tab.get_by_label("Speed (m/s)").fill("0.3")
            tab.get_by_role("button", name="Set the task").click()
            tab.get_by_text("path path.csv of").wait_for()
            assert stack.operator.status()["task"]["asked"]["speed_m_s"] == 0.3
            stack.drive(until_rad_s=4.0)
            wait_for(tab, lambda: "of 9.14 m" in (frame.locator("body").text_content() or ""))
            keep(tab, "path")
            before = stack.operator.status()
            for _ in range(3):
                tab.reload()
                tab.get_by_text("ARMED · running").wait_for()
            after = stack.operator.status()
            assert after["running"]
            assert after["task"]["laps"] > before["task"]["laps"]
            assert after["recorder"]["dropped_ticks"] == 0
            tab.get_by_role("button", name="E-STOP").click()
            stack.operator.wait_for("FAULT", 10.0)
