"""The live page of a running robot: it draws what is so, stops and drives the wheels, and cannot touch the loop."""

import os
import shutil
import signal
import time
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

import numpy as np
import pytest

from disco_hw.daemon import send_request
from disco_hw.drive import INPUT_LIMIT_NS
from disco_hw.experiments import disco_hw_process, is_stationary
from disco_hw.log.reader import open_log
from disco_hw.runtime.robot_setup import load_setup
from disco_hw.viewer import scene
from tests.drivers.waiting import free_port
from tests.hil.stack import DECELERATION_RAD_S2, STATIONARY_RAD_S
from tests.hil.test_drive import Bench
from tests.viewer.camera import project, screenshot, shows
from tests.viewer.test_page import scene_canvas, wait_for
from tools.browser import chromium, keep, opened
from tools.stack import running_stack

pytestmark = [pytest.mark.hil, pytest.mark.long, pytest.mark.browser]
# Ticks, the link, and a machine that has other things to do.
MARGIN_S = 0.1


def address(output: Path, timeout_s: float = 60.0) -> str:
    deadline = time.monotonic() + timeout_s
    while time.monotonic() < deadline:
        for line in output.read_text().splitlines() if output.exists() else []:
            if line.startswith("page: "):
                return line.split()[1]
        time.sleep(0.05)
    raise AssertionError(f"no page: {output.read_text()}")


@contextmanager
def page_of(robot_file, output):
    """A live page in a process of its own, and its address."""
    view = ["view", "--live", "--port", str(free_port()), "--robot", str(robot_file)]
    with disco_hw_process("page", view, output) as page:
        yield page.process, address(output)


@pytest.mark.timeout(300)
def test_the_page_draws_the_robot_survives_being_stopped_and_its_estop_stops_the_wheels(tmp_path):
    with chromium() as browser, running_stack(tmp_path) as stack:
        with page_of(stack.robot_file, tmp_path / "page.txt") as (page, url), opened(browser, url, 760, 560) as tab:
            stack.operator.wait_for("READY", 60.0)
            tab.frame_locator("#scene").get_by_text("READY, no fault").wait_for(state="attached")
            assert_visible(tab, stack)
            stack.drive()
            tab.get_by_text("ARMED · running").wait_for()
            frame = tab.frame_locator("#scene")
            wait_for(tab, lambda: "rad/s (plan)" in (frame.locator("body").text_content() or ""))
            keep(tab, "live")
            stop_the_page_for_a_while(stack, page.pid)
            tab.get_by_role("button", name="E-STOP").click()
            stack.operator.wait_for("FAULT", 10.0)
            stopped_s = time.monotonic()
            tab.get_by_text("The stop is latched.").wait_for()
            keep(tab, "estop")
            assert_visible(tab, stack, line=False)
            tab.get_by_role("button", name="Reset").click()
            stack.operator.wait_for("READY", 10.0)
            set_the_task(tab, stack)
            os.kill(page.pid, signal.SIGTERM)
            assert page.wait(10) == 0
        rows = stack.truth()
    with open_log(tmp_path / "run.mcap") as log:
        paths = log.columns("/plan/rollouts")["weights"]
        assert len(paths) >= 2
        assert list(log.columns("/task")["settings.radius_m"]) == [2.5]
    assert any(row.fastest > 5.0 for row in rows)
    later = [row.fastest for row in rows if row.t_s > stopped_s + 0.5]
    assert later
    assert max(later) < STATIONARY_RAD_S


@pytest.mark.timeout(300)
def test_where_nothing_can_be_recorded_the_page_arms_only_after_a_second_press(tmp_path):
    logs = tmp_path / "logs"
    with (
        chromium() as browser,
        running_stack(tmp_path, run_arguments=("--log", str(logs / "run.mcap"))) as stack,
        page_of(stack.robot_file, tmp_path / "page.txt") as (_, url),
        opened(browser, url, 760, 560) as tab,
    ):
        stack.operator.wait_for("READY", 60.0)
        shutil.rmtree(logs)
        logs.write_text("in the way")
        stack.operator.wait_until("recording broken", lambda status: status["recorder"]["fault"], 10.0)
        tab.get_by_role("button", name="Arm", exact=True).click()
        anyway = tab.get_by_role("button", name="Arm unrecorded")
        anyway.wait_for()
        assert stack.operator.status()["state"] == "READY"
        anyway.click()
        stack.operator.wait_for("ARMED", 5.0)


def stop_the_page_for_a_while(stack, pid):
    """The robot goes on driving and the log goes on being written while the page's process does nothing."""
    os.kill(pid, signal.SIGSTOP)
    before = stack.operator.status()
    time.sleep(2.0)
    after = stack.operator.status()
    os.kill(pid, signal.SIGCONT)
    assert after["state"] == "ARMED"
    assert after["task"]["laps"] > before["task"]["laps"] + 0.02
    assert after["driver"]["commands_sent"] > before["driver"]["commands_sent"] + 50
    assert after["recorder"]["dropped_ticks"] == 0


def assert_visible(tab, stack, line=True, empty_place=(0.0, 0.0)):
    """Robot and task have their colours where they are in the world, seen from the page's first camera.

    `beside` is a place where neither of them is.
    """
    task = load_setup(stack.robot_file).config.task
    x_m, y_m, _ = stack.operator.wait_until("standing still", is_stationary, 5.0)["pose"]
    canvas = scene_canvas(tab)
    eye, look_at = scene.first_camera(task)

    def place(*point):
        column, row = project(point, eye, look_at, canvas["width"], canvas["height"])
        return column + canvas["x"], row + canvas["y"]

    outline = task.course().outline_m()
    clear = outline[np.hypot(outline[:, 0] - x_m, outline[:, 1] - y_m) > 0.6]
    on_line = [place(x, y, 0.0) for x, y in clear[:: len(clear) // 5]] if line else []

    def everything_is_there():
        close_notices(tab)
        picture = screenshot(tab)
        return (
            all(shows(picture, column, row, scene.LAYERS["task"].colour, 3) for column, row in on_line)
            and shows(picture, *place(x_m, y_m, 0.1), scene.LAYERS["robot"].colour, 4)
            and not shows(picture, *place(*empty_place, 0.0), scene.LAYERS["task"].colour, 3)
            and not shows(picture, *place(*empty_place, 0.0), scene.LAYERS["robot"].colour, 3)
        )

    wait_for(tab, everything_is_there, 120.0)


def close_notices(tab):
    """The browser says that it draws without a graphics card, over the picture."""
    buttons = "document.querySelectorAll('.mantine-Notification-closeButton')"
    tab.frames[1].evaluate(f"for (const button of {buttons}) button.click()")


def set_the_task(tab, stack):
    """Another circle, from the page: within the limits, and only within."""
    tab.get_by_role("button", name="Task…").click()
    tab.get_by_label("Radius (m)").fill("2.5")
    tab.get_by_label("Speed (m/s)").fill("0.3")
    keep(tab, "task")
    tab.get_by_role("button", name="Set the task").click()
    tab.get_by_text("circle of 2.5 m").wait_for()
    assert stack.operator.status()["task"]["asked"]["radius_m"] == 2.5
    tab.get_by_label("Speed (m/s)").fill("5")
    tab.get_by_role("button", name="Set the task").click()
    tab.get_by_text("task refused").wait_for()
    assert stack.operator.status()["task"]["asked"]["speed_m_s"] == 0.3


@pytest.mark.timeout(300)
def test_a_request_that_the_page_died_with_is_said_to_have_no_answer(tmp_path):
    with (
        chromium() as browser,
        running_stack(tmp_path) as stack,
        page_of(stack.robot_file, tmp_path / "page.txt") as (page, url),
        opened(browser, url, 760, 560) as tab,
    ):
        stack.operator.wait_for("READY", 60.0)
        tab.frame_locator("#scene").get_by_text("READY, no fault").wait_for(state="attached")
        os.kill(page.pid, signal.SIGSTOP)
        tab.get_by_role("button", name="Arm", exact=True).click()
        os.kill(page.pid, signal.SIGKILL)
        tab.get_by_text("arm: no answer").wait_for()
        assert stack.operator.status()["state"] == "READY"
        page.wait(10)


@pytest.mark.timeout(300)
def test_the_pad_drives_while_it_is_held_and_seen(tmp_path):
    with chromium() as browser, ExitStack() as stack, (tmp_path / "drive.txt").open("wb") as output:
        bench = Bench(tmp_path, stack)
        drive = bench.drive("--page", "--port", str(free_port()), stdout=output, stderr=output)
        url = address(tmp_path / "drive.txt")
        with opened(browser, url, 700, 620, scene=False) as tab:
            pad = tab.get_by_label("Pad: hold")
            pad.wait_for()
            bench.operator.wait_for("READY", 60.0)
            ends = [
                release(tab, pad, bench),
                hide(tab, pad, bench),
                leave(tab, pad, bench),
            ]
        with opened(browser, url, 700, 620, scene=False) as tab:
            ends.append(lose(tab, tab.get_by_label("Pad: hold"), bench, drive))
        assert send_request(tmp_path / "control.sock", {"do": "quit"})["ok"]
        assert drive.wait(20) == 0
        t_s, wheels = bench.truth()
    fastest = abs(wheels).max(axis=1)
    for name, ended_s, limit_s in ends:
        before = fastest[(t_s > ended_s - 0.3) & (t_s < ended_s)]
        assert before.max() > 1.0, f"{name}: nothing moved"
        stationary_s = ended_s + limit_s + before.max() / DECELERATION_RAD_S2 + 0.15 + MARGIN_S
        after = fastest[(t_s > stationary_s) & (t_s < stationary_s + 0.3)]
        assert after.max() < STATIONARY_RAD_S, f"{name}: {after.max()} rad/s {limit_s} s later"


def hold(tab, pad, bench):
    """Press the pad and pull it forward until the wheels turn."""
    box = pad.bounding_box()
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    for _ in range(5):
        bench.operator.wait_for("READY", 20.0)
        tab.mouse.move(x, y)
        tab.wait_for_timeout(250)
        tab.mouse.down()
        tab.mouse.move(x, y - 40, steps=2)
        deadline = time.monotonic() + 4.0
        while time.monotonic() < deadline:
            tab.wait_for_timeout(50)
            if (wheels := bench.operator.status()["wheels"]) is not None and min(wheels) > 1.5:
                return
        # A browser that is starved of its processor loses the hold, as it should.
        tab.mouse.up()
    raise AssertionError(f"never drove: {bench.operator.status()['drive']}")


def release(tab, pad, bench):
    hold(tab, pad, bench)
    keep(tab, "drive")
    tab.mouse.up()
    return "released", time.monotonic(), 0.0


def hide(tab, pad, bench):
    hold(tab, pad, bench)
    tab.evaluate("Object.defineProperty(document, 'hidden', {value: true, configurable: true});"
                 "document.dispatchEvent(new Event('visibilitychange'))")  # fmt: skip
    ended_s = time.monotonic()
    tab.wait_for_timeout(700)
    tab.mouse.up()
    tab.evaluate("delete document.hidden")
    return "hidden", ended_s, 0.0


def leave(tab, pad, bench):
    hold(tab, pad, bench)
    tab.goto("about:blank")
    ended_s = time.monotonic()
    time.sleep(0.7)
    return "left", ended_s, INPUT_LIMIT_NS * 1e-9


def lose(tab, pad, bench, drive):
    """The page's process falls silent: nothing says that the pad was let go."""
    pad.wait_for()
    hold(tab, pad, bench)
    page = page_process_of(drive.pid)
    os.kill(page, signal.SIGSTOP)
    ended_s = time.monotonic()
    time.sleep(1.5)
    os.kill(page, signal.SIGCONT)
    time.sleep(1.0)
    assert bench.operator.status()["state"] == "READY"
    tab.mouse.up()
    return "lost", ended_s, INPUT_LIMIT_NS * 1e-9


def page_process_of(pid):
    """The process of the page that this one has started."""
    for each in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            parent = (each / "stat").read_text().rpartition(")")[2].split()[1]
            if int(parent) == pid and b"disco_hw.viewer.commands" in (each / "cmdline").read_bytes():
                return int(each.name)
    raise AssertionError("no page beside the drive")
