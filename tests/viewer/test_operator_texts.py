"""The texts around the live page are whole at every width from a phone's to a desk's, in every state, light or dark."""

from contextlib import ExitStack, contextmanager

import pytest

from disco_hw.viewer.operator_controls import Desk
from disco_hw.viewer.server import serving
from tests.viewer.camera import as_golden, off_golden, screenshot
from tests.viewer.test_operator_controls import STATUS, Daemon
from tools.browser import keep, opened, unnamed
from tools.viewer_run import ROBOT_FILE

pytestmark = [pytest.mark.long, pytest.mark.browser]

WIDTHS = (390, 430, 540, 600, 768, 900, 1000, 1001, 1100, 1280, 1400, 1600)
SCHEMES = ("light", "dark")
HEIGHT = 844

LINK_ERROR = (
    "socketcan can0: no such CAN interface; plug the adapter in and run: "
    "sudo ip link set can0 up type can bitrate 500000"
)
LIMITS = {"asked": {"kind": "circle", "radius_m": 0.75, "speed_m_s": 0.2, "center_x_m": 0.0, "center_y_m": 0.0},
          "limits": {name: [0.1, 50.0] for name in ("radius_m", "speed_m_s", "center_x_m", "center_y_m")},
          "labels": {"radius_m": "Radius (m)", "speed_m_s": "Speed (m/s)", "center_x_m": "Centre x (m)",
                     "center_y_m": "Centre y (m)"},
          "note": "Radius 0.1 to 50 m; at 0.75 m at most 0.318 m/s."}  # fmt: skip
COMPLETE_STATUS = {**STATUS, "task": LIMITS}
DRIVE_BY_PAGE = {
    "by_page": True,
    "driving": False,
    "words": "hold the pad to drive; the robot is armed by holding, not by Arm",
}
STATES = {
    "disconnected": {"state": "DISCONNECTED", "detail": LINK_ERROR, "robot_state": "UNKNOWN"},
    "handshake": {
        "state": "HANDSHAKE",
        "detail": "no answer from the robot; check that it is switched on and uses the same bit rate",
    },
    "ready": {},
    "armed": {"state": "ARMED", "detail": "armed, commanding zero speed"},
    "running": {"state": "ARMED", "detail": "running the task", "running": True},
    "stopping": {
        "state": "STOPPING",
        "detail": "the robot is no longer armed: no wheel command arrived in time: the link or this host was too slow; "
        "check the load of both; waiting until the robot is disarmed and its wheels have stopped",
    },
    "fault": {
        "state": "FAULT",
        "fault": "OVER_VOLTAGE",
        "detail": "the robot reports OVER_VOLTAGE; mend it, then reset",
    },
    "estop": {
        "state": "FAULT",
        "estop": True,
        "robot_state": "ESTOP",
        "detail": "e-stop requested by the operator; mend it, then reset",
    },
    "by hand": {"state": "READY", "drive": DRIVE_BY_PAGE},
}

# Every element that holds text of its own: is all of it inside of the element and of the window?
CUT_OFF = """() => [...document.querySelectorAll("body *:not(script)")].flatMap(element => {
  const own = [...element.childNodes].some(node => node.nodeType === Node.TEXT_NODE && node.textContent.trim());
  if (!own || !element.checkVisibility()) return [];
  const box = element.getBoundingClientRect(), faults = [];
  for (let holder = element; holder; holder = holder.parentElement) {
    if (getComputedStyle(holder).display === "inline") continue;
    if (holder.scrollWidth > holder.clientWidth) faults.push(`${holder.id || holder.tagName} is ${holder.scrollWidth} in ${holder.clientWidth} wide`);
    if (holder.scrollHeight > holder.clientHeight) faults.push(`${holder.id || holder.tagName} is ${holder.scrollHeight} in ${holder.clientHeight} high`);
  }
  if (box.left < 0 || box.right > innerWidth || box.top < 0 || box.bottom > innerHeight) faults.push("reaches out of the window");
  return faults.map(fault => `"${element.textContent.trim().slice(0, 40)}": ${fault}`);
})"""  # noqa: E501


# All that can be operated, in the order of the page; what is disabled is left out.
OPERATED = """() => [...document.querySelectorAll("button, input, [tabindex='0']")]
  .filter(element => element.checkVisibility() && !element.disabled)
  .map(element => element.id || element.textContent)"""


def reached(tab):
    """What the Tab key comes to, from the page's beginning on."""
    tab.evaluate("() => { document.activeElement?.blur(); document.body.tabIndex = -1; document.body.focus(); }")
    found = []
    for _ in tab.evaluate(OPERATED):
        tab.keyboard.press("Tab")
        found.append(tab.evaluate("() => document.activeElement.id || document.activeElement.textContent"))
    return found


@pytest.fixture
def daemon(tmp_path):
    made = Daemon(tmp_path / "run")
    yield made
    made.close()


@contextmanager
def desk_at(socket):
    """The address of a served desk."""
    desk = Desk(socket, ROBOT_FILE)
    with serving("test", port=0, desk=desk) as page:
        yield page.url
    desk.close()


def cut_off(tab, name):
    """What is cut off of the page's texts, at all widths and in both colour schemes."""
    found = []
    for scheme in SCHEMES:
        tab.emulate_media(color_scheme=scheme)
        for width in WIDTHS:
            tab.set_viewport_size({"width": width, "height": HEIGHT})
            found += [f"{name}, {scheme}, {width} px: {fault}" for fault in tab.evaluate(CUT_OFF)]
            if scheme == "light" and width in (390, 768, 1400):
                keep(tab, f"desk-{name}-{width}")
    return found


def test_a_dark_room_darkens_the_desk(browser, daemon):
    desk = Desk(daemon.server.path, ROBOT_FILE)
    with serving("test", port=0, desk=desk) as page, opened(browser, page.url, scene=False) as tab:
        tab.locator("#state", has_text="READY").wait_for()
        lightness = (
            "() => getComputedStyle(document.querySelector('header')).backgroundColor.match(/\\d+/g).map(Number)"
        )
        assert min(tab.evaluate(lightness)) > 200
        desk.dark = True
        tab.locator("body.dark").wait_for()
        assert max(tab.evaluate(lightness)) < 60
        assert cut_off(tab, "dark") == []
    desk.close()


@pytest.mark.parametrize("name", ["ready", "running", "estop", "by hand"])
def test_the_desk_looks_as_it_did(browser, daemon, name):
    daemon.status = {**COMPLETE_STATUS, **STATES[name]}
    with desk_at(daemon.server.path) as url, opened(browser, url, scene=False) as tab:
        tab.locator("#detail", has_text=daemon.status["detail"][:60]).wait_for()
        # A frame that was not loaded shows now a sign for that, and now none; nor does a caret or a mouse belong here.
        tab.add_style_tag(content="#scene { visibility: hidden; }")
        for width in (390, 800, 1400):
            tab.set_viewport_size({"width": width, "height": 480})
            picture, kept = screenshot(tab), f"desk-{name.replace(' ', '-')}-{width}"
            assert as_golden(picture, kept), (kept, off_golden(picture, kept))
        tab.add_style_tag(content="#estop { background: #005500 !important; }")
        assert not as_golden(screenshot(tab), kept)


@pytest.mark.parametrize(("width", "height"), [(390, 844), (360, 640), (640, 900), (844, 390), (640, 360), (1400, 620)])
def test_the_pad_lies_over_neither_the_e_stop_nor_on_a_small_screen_the_scene(browser, daemon, width, height):
    daemon.status = {**COMPLETE_STATUS, **STATES["by hand"]}
    with desk_at(daemon.server.path) as url, opened(browser, url, width, height, scene=False) as tab:
        tab.locator("#drive").wait_for()
        pad, card, scene, bar = (tab.locator(f"#{each}").bounding_box() for each in ("pad", "drive", "scene", "top"))
        assert bar["y"] + bar["height"] <= card["y"] < card["y"] + card["height"] <= height
        assert apart(card, scene)
        assert scene["width"] > 0.5 * width
        assert scene["height"] > 0.35 * height
        assert pad["width"] >= 120.0
        tab.mouse.move(pad["x"] + 0.5 * pad["width"], pad["y"] + 0.5 * pad["height"])
        tab.mouse.down()
        tab.mouse.move(pad["x"] + 0.5 * pad["width"], pad["y"] + 2.0)
        tab.wait_for_timeout(300)
        pulled = [arguments for action, arguments in daemon.received if action == "drive" and arguments["held"]]
        assert pulled[-1]["forward"] == pytest.approx(0.5)
        tab.mouse.up()
        script = "() => { at('padsays').textContent = 'no daemon hears the pad'; return (%s)(); }"
        assert tab.evaluate(script % CUT_OFF) == []
        keep(tab, f"pad-{width}-{height}")


def apart(one, other):
    """Whether two boxes share no pixel."""
    return any(
        low[edge] + low[size] <= high[edge]
        for edge, size in (("x", "width"), ("y", "height"))
        for low, high in ((one, other), (other, one))
    )


def test_what_is_dragged_in_the_scene_stands_in_the_form_and_escape_closes_it(browser, daemon):
    daemon.status = COMPLETE_STATUS
    desk = Desk(daemon.server.path, ROBOT_FILE)
    with serving("test", port=0, desk=desk) as page, opened(browser, page.url, scene=False) as tab:
        tab.locator("#state", has_text="READY").wait_for()
        tab.locator("#taskbutton").click()
        tab.get_by_text("drag the balls").wait_for()
        tab.wait_for_timeout(500)
        desk.drag({"radius_m": 1.234})
        tab.wait_for_function("() => document.getElementById('radius_m').value === '1.23'")
        tab.get_by_label("Centre x (m)").fill("0.4")
        tab.wait_for_timeout(500)
        assert desk.draft["center_x_m"] == 0.4
        tab.keyboard.press("Escape")
        tab.locator("#task").wait_for(state="hidden")
        tab.wait_for_timeout(500)
        assert desk.draft is None
    desk.close()


@pytest.mark.parametrize("name", STATES)
def test_every_text_is_whole(browser, daemon, name):
    daemon.status = {**COMPLETE_STATUS, **STATES[name]}
    with desk_at(daemon.server.path) as url, opened(browser, url, scene=False) as tab:
        detail = daemon.status["detail"]
        tab.locator("#detail", has_text=detail[:60]).wait_for()
        assert cut_off(tab, name) == []
        # The longest answers of the daemon are refusals.
        tab.evaluate("text => answer(text, true)", f"arm refused: not connected to the robot: {LINK_ERROR}")
        assert cut_off(tab, f"{name}, answered") == []
        if name == "ready":
            tab.locator("#taskbutton").click()
            tab.get_by_label("Radius (m)").wait_for()
            assert cut_off(tab, "task") == []
        assert unnamed(tab) == []
        assert reached(tab) == tab.evaluate(OPERATED)


def test_the_stop_button_stays_where_it_is_whatever_is_said(browser, daemon):
    with desk_at(daemon.server.path) as url, opened(browser, url, scene=False) as tab:
        places = {}
        for name in ("ready", "disconnected", "stopping"):
            daemon.status = {**COMPLETE_STATUS, **STATES[name]}
            tab.locator("#detail", has_text=daemon.status["detail"][:60]).wait_for()
            for width in WIDTHS:
                tab.set_viewport_size({"width": width, "height": HEIGHT})
                box = tab.locator("#estop").bounding_box()
                places.setdefault(width, set()).add(tuple(box.values()))
    assert {width: len(found) for width, found in places.items()} == dict.fromkeys(WIDTHS, 1)


def test_every_text_is_whole_without_a_daemon(browser, tmp_path):
    with desk_at(tmp_path / "none.sock") as url, opened(browser, url, scene=False) as tab:
        tab.locator("#state", has_text="NO DAEMON").wait_for()
        assert cut_off(tab, "no daemon") == []


def test_every_text_is_whole_without_a_connection(browser, daemon):
    with ExitStack() as ending:
        url = ending.enter_context(desk_at(daemon.server.path))
        with opened(browser, url, scene=False) as tab:
            tab.locator("#state", has_text="READY").wait_for()
            ending.close()
            tab.locator("#estop", has_text="NO CONNECTION").wait_for()
            tab.locator("#state", has_text="NO CONNECTION").wait_for()
            assert cut_off(tab, "no connection") == []
            tab.locator("#estop").click()
            tab.locator("#answer", has_text="NOT SENT").wait_for()
            assert cut_off(tab, "no connection, pressed") == []
