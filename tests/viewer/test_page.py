"""The pages in a real browser: what is drawn, what the buttons do, what the page asks of the network."""

import json
import math
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from disco_hw.viewer import scene
from disco_hw.viewer.commands import export_log
from disco_hw.viewer.operator_controls import Desk
from disco_hw.viewer.pages import LivePage, ReplayPage, run_live, run_replay
from disco_hw.viewer.recording import stage_of_robot
from disco_hw.viewer.server import serving
from tests.viewer.camera import as_golden, off_golden, project
from tests.viewer.test_operator_controls import STATUS, Daemon
from tools.browser import keep, opened, unnamed
from tools.viewer_run import FAULT_TICK, RADIUS_M, ROBOT_FILE, pose_at, tick_records

pytestmark = [pytest.mark.long, pytest.mark.browser]

HEIGHT_M, FIELD_OF_VIEW, SIZE = 2.5, math.radians(60.0), 480


@pytest.fixture
def replay(recording):
    """A replay page that is running, and its address."""
    with serving("test", port=0) as served:
        page = ReplayPage(served.server, recording)
        ending = threading.Event()
        thread = threading.Thread(target=run_replay, args=(page, ending.is_set))
        thread.start()
        yield page, served
        ending.set()
        thread.join()


def wait_for(page, condition, timeout_s=60.0):
    """Let the browser work until something is so."""
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline, "waited in vain"
        page.wait_for_timeout(50)


def from_above(page, server, attempts=3):
    """What the browser draws of the scene, seen from above the origin: x to the right, y up."""
    position, down = (0.0, 0.0, HEIGHT_M), (0.0, 1.0, 0.0, 0.0)
    for _ in range(attempts):
        wait_for(page, lambda: len(server.get_clients()) == 1)
        client = next(iter(server.get_clients().values()))
        with ThreadPoolExecutor(1) as pool:
            rendering = pool.submit(client.get_render, SIZE, SIZE, wxyz=down, position=position, fov=FIELD_OF_VIEW)
            wait_for(page, rendering.done)
        # A browser that is starved of its processor loses the connection and makes a new one.
        if rendering.exception() is None:
            return rendering.result()[:, :, :3].astype(int)
    raise rendering.exception()


def pixel(x_m, y_m, z_m=0.0):
    """Row and column of a point of the world."""
    scale = 0.5 * SIZE / math.tan(0.5 * FIELD_OF_VIEW) / (HEIGHT_M - z_m)
    return round(0.5 * SIZE - scale * y_m), round(0.5 * SIZE + scale * x_m)


def hue_near(picture, row, column, reach=5):
    """The most colourful pixel near a place."""
    part = picture[row - reach : row + reach + 1, column - reach : column + reach + 1].reshape(-1, 3)
    return part[np.argmax(np.ptp(part, axis=1))]


def like(colour, expected):
    """Whether the order of the channels is that of the wanted colour, clearly."""
    return np.argmax(colour) == np.argmax(expected) and np.argmin(colour) == np.argmin(expected) and np.ptp(colour) > 60


def test_a_browser_without_a_graphics_card_draws_few_pixels_and_its_notice_goes(browser, replay):
    _, served = replay
    with opened(browser, served.url, 1400, 900) as page:
        page.wait_for_function("window.__viserMutable?.canvas?.width")
        assert page.evaluate("""() => {
          const {canvas} = window.__viserMutable;
          return [canvas.getContext("webgl2").getContextAttributes().antialias, canvas.width * canvas.height <= 5e5];
        }""") == [False, True]
        notice = page.get_by_text("Software WebGL rendering detected")
        notice.wait_for()
        notice.wait_for(state="detached")


def test_circle_and_robot_are_drawn_at_their_places_and_replay_is_sought(browser, replay):
    page, served = replay
    with opened(browser, served.url) as tab:
        tab.get_by_role("button", name="Play").wait_for()
        wait_for(tab, lambda: len(served.server.get_clients()) == 1)
        tab.wait_for_timeout(1000)
        for tick in (0, 150):
            page.go_to(tick * 0.02)
            tab.get_by_text(f"{tick * 0.02:.3f} s", exact=True).wait_for()
            tab.wait_for_timeout(500)
            picture = from_above(tab, served.server)
            x_m, y_m, yaw_rad = pose_at(tick)
            # Behind the middle, clear of the ellipse that is drawn above the body.
            body = picture[pixel(x_m - 0.1 * math.cos(yaw_rad), y_m - 0.1 * math.sin(yaw_rad), 0.12)]
            assert like(body, scene.LAYERS["robot"].colour), body
        assert as_golden(picture, "scene"), off_golden(picture, "scene")
        for degrees in (100, 190, 280):
            x_m, y_m = (RADIUS_M * part(math.radians(degrees)) for part in (math.cos, math.sin))
            line = hue_near(picture, *pixel(x_m, y_m))
            assert like(line, scene.LAYERS["task"].colour), (degrees, line)
        assert not like(picture[pixel(0.0, 0.0)], scene.LAYERS["task"].colour)
        keep(tab, "replay")
        tab.get_by_role("button", name="+1", exact=True).click()
        wait_for(tab, lambda: page.t_s == pytest.approx(3.02))
        tab.get_by_role("button", name="Play").click()
        wait_for(tab, lambda: page.t_s > 3.1)
        tab.get_by_role("combobox", name="Marks").click()
        tab.get_by_role("option").filter(has_text="fault:").first.click()
        wait_for(tab, lambda: page.t_s == pytest.approx(FAULT_TICK * 0.02) and not page.playing)
        slider = tab.get_by_role("slider").first
        slider.focus()
        slider.press("Home")
        wait_for(tab, lambda: page.t_s == 0.0 and not page.playing)
        with opened(browser, served.url, 480, 320) as other:
            other.get_by_role("button", name="Play").wait_for()
            other.get_by_role("button", name="+1", exact=True).click()
            tab.get_by_text("0.020 s", exact=True).wait_for()
            assert len(served.server.get_clients()) == 2
        elsewhere = [
            text
            for text in tab.output_lines
            if text.startswith("request http") and served.url.split("?")[0] not in text
        ]
        assert elsewhere == []


# Where things are: the picture, the boxes of panel and bar of time, and heads of folds that only a mouse would reach.
LAYOUT = """() => {
  const place = element => (({x, y, width, height}) => ({x, y, width, height}))(element.getBoundingClientRect());
  const boxes = [...document.querySelectorAll(".mantine-Paper-root")];
  const panel = boxes.find(box => box.textContent.includes("Play"));
  const bar = boxes.find(box => box.textContent.startsWith("Time and marks"));
  return {canvas: place(document.querySelector("canvas")), panel: panel && place(panel), bar: bar && place(bar),
          mouse: [...document.querySelectorAll("[style*='cursor: pointer']")].filter(head => head.checkVisibility()
            && head.tabIndex < 0 && !head.closest("button, label, [role=button], [role=tab], [role=slider]")
            && !head.querySelector("input, [role=slider]")).map(head => head.outerHTML.slice(0, 120))};
}"""


@pytest.mark.parametrize("width", [390, 800, 1400])
def test_every_control_has_a_name_and_keys_and_a_phone_sees_the_scene_and_the_panel(browser, replay, width):
    page, served = replay
    page.go_to(3.0)
    with opened(browser, served.url, width, 844) as tab:
        tab.get_by_role("button", name="Play").wait_for()
        wait_for(tab, lambda: unnamed(tab) == [])
        wait_for(tab, lambda: tab.evaluate(LAYOUT)["mouse"] == [])
        if width == 390:
            wait_for(tab, lambda: not_covered(tab.evaluate(LAYOUT)))
            head = tab.get_by_role("button", name="Show or hide the panel")
            before = tab.evaluate(LAYOUT)["panel"]["height"]
            head.focus(timeout=30_000)
            head.press("Enter")
            wait_for(tab, lambda: tab.evaluate(LAYOUT)["canvas"]["height"] > 844 - 0.6 * before)
        else:
            wait_for(tab, lambda: as_wide_as_the_picture(tab.evaluate(LAYOUT)))
        keep(tab, f"replay-{width}")


def as_wide_as_the_picture(there):
    """The bar of time, but for a margin on either side."""
    return there["bar"] and there["bar"]["width"] == pytest.approx(there["canvas"]["width"] - 24.0, abs=1.0)


def not_covered(there):
    """The panel is as wide as the phone and begins where the picture ends, which has half of the screen."""
    canvas, panel = there["canvas"], there["panel"]
    return (
        panel["width"] == canvas["width"] == 390
        and abs(canvas["y"] + canvas["height"] - panel["y"]) < 2.0
        and canvas["height"] > 0.5 * 844
    )


def test_an_exported_page_plays_from_the_file_alone(browser, log_file, tmp_path):
    export_log(log_file, tmp_path / "run.html")
    with opened(browser, (tmp_path / "run.html").as_uri()) as tab:
        tab.locator("canvas").first.wait_for()
        wait_for(tab, lambda: any("Embedded data loaded" in text for text in tab.output_lines))
        keep(tab, "export")
        requests = [text for text in tab.output_lines if text.startswith("request") and "http" in text]
        assert requests == []


_CIRCLE = {"radius_m": 0.75, "speed_m_s": 0.2, "center_x_m": 0.0, "center_y_m": 0.0}
COMPLETE_STATUS = {
    **STATUS, "stop_cause": "NONE", "link": "up", "link_error": "", "adaptation": None,
    "task": {"asked": {"kind": "circle", **_CIRCLE}, "limits": {name: [-50.0, 50.0] for name in _CIRCLE},
             "labels": {**{name: name for name in _CIRCLE}, "center_x_m": "Centre x (m)"}, "note": "",
             "progress": ["laps", "0.0"], "distance_m": 0.0},
    "recorder": {"fault": "", "last_error": "", "path": ""},
    "loop": {"lateness_us": {"p99": 1.0, "max": 2.0}, "overruns": 0, "skipped": 0},
    "transport": {"frames_received": 0, "frames_sent": 0, "malformed": 0}, "driver": {"lost_frames": 0},
}  # fmt: skip


@pytest.fixture
def operated(tmp_path):
    """A page beside a daemon that does what it is asked to: address, page, daemon and the operator's desk."""
    daemon = Daemon(tmp_path / "run")
    daemon.status = COMPLETE_STATUS
    desk, ending = Desk(daemon.server.path, ROBOT_FILE), threading.Event()
    with serving("test", port=0, desk=desk) as page:
        live = LivePage(page.server, stage_of_robot(ROBOT_FILE), daemon.server.path, desk)
        live.ingest([(now_ns, record) for now_ns, got in map(tick_records, range(20)) for record in got])
        thread = threading.Thread(target=run_live, args=(live, ending.is_set))
        thread.start()
        try:
            yield page.url, live, daemon, desk
        finally:
            ending.set()
            thread.join()
            desk.close()
            daemon.close()


def test_the_circle_is_dragged_with_the_mouse_and_set(browser, operated):
    url, live, daemon, desk = operated
    with opened(browser, url, 760, 600) as tab:
        tab.get_by_role("button", name="Task…").click()
        tab.get_by_text("drag the balls").wait_for()
        wait_for(tab, lambda: live.editor.balls["middle"].visible)
        tab.evaluate("() => { document.getElementById('task').style.visibility = 'hidden'; }")
        tab.wait_for_timeout(3000)
        drag(tab, (0.0, 0.0), (0.3, -0.2))
        wait_for(tab, lambda: desk.draft["center_x_m"] == pytest.approx(0.3, abs=0.08))
        assert desk.draft["center_y_m"] == pytest.approx(-0.2, abs=0.08)
        keep(tab, "task-dragged")
        tab.evaluate("() => { document.getElementById('task').style.visibility = ''; }")
        wait_for(tab, lambda: float(tab.get_by_label("Centre x (m)").input_value()) == desk.draft["center_x_m"])
        tab.get_by_role("button", name="Set the task").click()
        wait_for(tab, lambda: any(action == "task" for action, _ in daemon.received))
        requested = next(arguments for action, arguments in daemon.received if action == "task")
        assert requested["center_x_m"] == desk.draft["center_x_m"]


def test_the_fence_is_typed_and_cornered_by_the_robots_nose_and_put_in_force(browser, operated):
    url, live, daemon, _ = operated
    with opened(browser, url, 1200, 900) as tab:
        tab.set_default_timeout(40_000)
        panel = tab.frame_locator("#scene")
        panel.get_by_text("Fence", exact=True).locator("visible=true").click()
        stay_in = panel.get_by_label("Stay in")
        panel.get_by_role("button", name="Corner at the robot's nose").click()
        x, y, yaw = live.fence_editor._pose
        ahead = live.fence_editor._footprint.ahead + 0.5 * live.fence_editor._footprint.length
        nose = [[round(x + ahead * math.cos(yaw), 3), round(y + ahead * math.sin(yaw), 3)]]
        wait_for(tab, lambda: stay_in.input_value() == json.dumps(nose))
        stay_in.fill("[[-2, -1.5], [2, -1.5], [2, 1.5], [-2, 1.5]]")
        panel.get_by_label("Keep out of").fill('[{"center": [0.9, 0], "radius_m": 0.15}]')
        wait_for(tab, lambda: "radius_m" in live.fence_editor._keep_out.value)
        panel.get_by_role("button", name="Use this fence").click()
        wait_for(tab, lambda: any(action == "fence" for action, _ in daemon.received))
        requested = next(arguments for action, arguments in daemon.received if action == "fence")
        assert requested["keep_in"] == [[-2, -1.5], [2, -1.5], [2, 1.5], [-2, 1.5]]
        assert requested["keep_out"] == [{"center": [0.9, 0], "radius_m": 0.15}]
        assert requested["margin_m"] == 0.05
        panel.get_by_text("done it").wait_for()
        keep(tab, "fence-editor")


def drag(tab, start, end):
    """With the mouse, from a place of the floor to another, seen from the page's first camera."""
    canvas = scene_canvas(tab)
    eye, look_at = scene.first_camera(stage_of_robot(ROBOT_FILE).task)
    places = [project((*place, 0.0), eye, look_at, canvas["width"], canvas["height"]) for place in (start, end)]
    (x, y), to = [(column + canvas["x"], row + canvas["y"]) for column, row in places]
    tab.mouse.move(x, y)
    tab.wait_for_timeout(500)
    tab.mouse.down()
    tab.mouse.move(x + 4, y, steps=2)
    tab.wait_for_timeout(300)
    tab.mouse.move(*to, steps=4)
    tab.wait_for_timeout(500)
    tab.mouse.up()


def scene_canvas(tab):
    """Where on the page the scene is drawn: the largest canvas of its frame."""
    frame = tab.locator("#scene").bounding_box()
    inside = tab.frames[1].evaluate("""() => [...document.querySelectorAll("canvas")].map(canvas => {
        const {x, y, width, height} = canvas.getBoundingClientRect(); return {x, y, width, height};
    }).reduce((one, other) => one.width * one.height > other.width * other.height ? one : other)""")
    return {**inside, "x": inside["x"] + frame["x"], "y": inside["y"] + frame["y"]}
