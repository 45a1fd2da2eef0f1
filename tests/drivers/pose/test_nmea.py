"""A GPS receiver: the vendors' own sentences, a library's, a real port and a real socket, and a reader killed."""

import itertools
import json
import math
import os
import signal
import socket
import subprocess
import time
import tty
from contextlib import ExitStack, suppress
from datetime import UTC, datetime, timedelta

import pytest

from disco_hw.runtime.pipeline import NoPlanner
from drivers.pose import PoseSourceError, create_pose_source
from drivers.pose.nmea import QUALITY_STD_M, Fixes, NmeaPoses, ReceiverClock, TangentPlane, _lines
from tests.drivers.waiting import receive_until
from tests.runtime.simulated import simulated_stack

pytest.importorskip("pynmeagps", reason="pip install 'disco-hw[rtk]'")

# From Trimble's, u-blox's and Hemisphere's interface descriptions; not made by any code of ours.
GGA_DIFFERENTIAL = b"$GPGGA,172814.0,3723.46587704,N,12202.26957864,W,2,6,1.2,18.893,M,-25.669,M,2.0,0031*4F\r\n"
GST = b"$GPGST,172814.0,0.006,0.023,0.020,273.6,0.023,0.020,0.031*6A\r\n"
GGA_ALONE = b"$GPGGA,092725.00,4717.11399,N,00833.91590,E,1,08,1.01,499.6,M,48.0,M,,*5B\r\n"
HDT = b"$GPHDT,123.456,T*32\r\n"
VTG = b"$GPVTG,77.52,T,,M,0.004,N,0.008,K,A*06\r\n"
RMC = b"$GPRMC,083559.00,A,4717.11437,N,00833.91522,E,0.004,77.52,091202,,,A*57\r\n"
NOW_NS = 10**12


def gga(time_s, latitude, longitude, quality=4, height=500.0):
    """By the library pynmeagps, from numbers."""
    from pynmeagps import GET, NMEAMessage

    when = (datetime(2026, 1, 1, tzinfo=UTC) + timedelta(seconds=time_s)).time()
    message = NMEAMessage(
        "GN", "GGA", GET, time=when, lat=latitude, NS="N" if latitude >= 0 else "S", lon=longitude,
        EW="E" if longitude >= 0 else "W", quality=quality, numSV=20, HDOP=0.6, alt=height, altUnit="M", sep=0.0,
        sepUnit="M", diffAge="", diffStation="", hpnmeamode=1,
    )  # fmt: skip
    return message.serialize()


def poses(found):
    return [each for each in found if "said" not in each]


def test_the_vendors_sentences_are_positions_with_their_quality():
    fixes = Fixes()
    (first,) = poses(fixes.add_line(GGA_ALONE, NOW_NS))
    assert first == {"t_ns": NOW_NS, "x_m": 0.0, "y_m": 0.0, "position_std_m": pytest.approx(3.0 * 1.01)}
    assert poses(fixes.add_line(VTG, NOW_NS)) == poses(fixes.add_line(RMC, NOW_NS)) == []
    assert fixes.malformed == 0
    differential = Fixes()
    assert poses(differential.add_line(GGA_DIFFERENTIAL, NOW_NS))[0]["position_std_m"] == pytest.approx(0.8 * 1.2)
    differential.add_line(GST, NOW_NS)
    assert poses(differential.add_line(GGA_DIFFERENTIAL, NOW_NS))[0]["position_std_m"] == 0.023


def test_east_and_north_agree_with_the_lengths_of_a_degree():
    """WGS 84 at 45 degrees: 111 131.745 m of latitude, 78 846.806 m of longitude (Rapp, Geometric Geodesy)."""
    fixes = Fixes(datum=(45.0, 7.0))
    moved = [(45.0, 7.0), (45.0 + 1e-3, 7.0), (45.0, 7.0 + 1e-3), (45.0 - 2e-3, 7.0 - 2e-3)]
    found = []
    for k, (latitude, longitude) in enumerate(moved):
        (pose,) = poses(fixes.add_line(gga(0.2 * k, latitude, longitude, height=0.0), NOW_NS + k * 200_000_000))
        found.append((pose["x_m"], pose["y_m"]))
    assert found[0] == pytest.approx((0.0, 0.0), abs=1e-3)
    assert found[1] == pytest.approx((0.0, 111.1317), abs=3e-3)
    assert found[2] == pytest.approx((78.8468, 0.0), abs=3e-3)
    assert found[3] == pytest.approx((-157.69, -222.26), abs=0.02)
    # A kilometre from its datum on the same ellipsoid, the plane is flat to a tenth of a metre.
    assert TangentPlane(-33.0, 151.0, 20.0).east_north(-33.0, 151.0, 30.0) == pytest.approx((0.0, 0.0), abs=1e-6)


@pytest.mark.parametrize(
    "broken",
    [
        GGA_ALONE.replace(b"*5B", b"*5C"),
        GGA_ALONE[:30],
        b"$GPGGA,092725.00,4717.11399,N,00833.91590,E,1,08,1.01,,M,48.0,M,,*4C\r\n",
        b"$GPGGA,,,,,,0,00,99.99,,,,,,*48\r\n",
        b"$GPGGA,1,2*00\r\n",
        b"\xff\xfe$$$*\r\n",
        b"$PUBX,00,hello*00\r\n",
        b"",
    ],
)
def test_what_is_no_fix_gives_none_and_breaks_nothing(broken):
    assert poses(Fixes().add_line(broken, NOW_NS)) == []


@pytest.mark.parametrize(
    "text",
    [
        "GNTHS,77.520",
        "GNHDT",
        "GNGST,092725.00.1.0y0.02,0.01,45.0,0.014,0.012,0.03",
        "GNGGA,092725.00",
        "GNGGA,092725.00,4717.11399,N,00833.91590,E,4",
        "GNGGA,092725.00,4717.11399,N,00833.91590,E,4,08,1.01,499.6,M",
    ],
)
def test_a_sentence_that_lacks_fields_is_malformed_and_changes_nothing(text):
    fixes, whole = Fixes(), Fixes()
    assert fixes.add_line(sentence(text), NOW_NS) == []
    assert fixes.malformed == 1
    assert fixes.add_line(GGA_ALONE, NOW_NS) == whole.add_line(GGA_ALONE, NOW_NS)


@pytest.mark.parametrize(
    "place",
    ["4717.e113979,N,00833.91590,E", "4717.e300,N,00833.91590,E", "9001.0,S,00833.91590,E", "4717.11399,N,18001.0,W",
     "nan17.1,N,00833.91590,E"],
)  # fmt: skip
def test_what_is_no_place_on_earth_is_no_position(place):
    found = parsed(fix(4, place=place), fix(4))
    assert [(pose["x_m"], pose["y_m"]) for pose in poses(found)] == [pytest.approx((0.0, 0.0), abs=1e-6)]


@pytest.mark.parametrize("altitude", ["nan", "inf", "1e300", "-1e200"])
def test_an_altitude_that_is_none_is_as_if_there_were_none(altitude):
    assert parsed(fix(4, altitude), fix(4)) == parsed(fix(4, ""), fix(4))


def test_a_datum_of_another_town_is_said():
    fixes = Fixes(datum=(47.0, 8.5))
    messages = [each["said"] for each in fixes.add_line(GGA_ALONE, NOW_NS) if "said" in each]
    assert "the position is 32097 m from the datum, and 838 m is the farthest allowed; correct pose.datum" in messages
    assert len(fixes.add_line(GGA_ALONE, NOW_NS)) == 1


@pytest.mark.parametrize("quality", [0, 6, 7, 8])
def test_what_is_not_measured_is_not_used_and_said_so(quality):
    fixes = Fixes()
    (message,) = fixes.add_line(gga(1.0, 47.0, 8.0, quality=quality), NOW_NS)
    assert f"fix quality {quality}" in message["said"]
    assert "not used" in message["said"]
    assert fixes.add_line(gga(1.2, 47.0, 8.0, quality=quality), NOW_NS) == []


def test_the_deviation_follows_the_quality():
    fixes = Fixes()
    for k, (quality, std_m) in enumerate(QUALITY_STD_M.items()):
        (pose,) = poses(fixes.add_line(gga(10.0 * k, 47.0, 8.0, quality=quality), NOW_NS + 10**10 * k))
        assert pose["position_std_m"] == std_m


def test_the_deviation_of_one_quality_is_not_that_of_another():
    """GST at 1 Hz, before or after the GGA of its time."""

    def deviation(*lines):
        return poses(parsed(*lines))[-1]["position_std_m"]

    fine, rough = sentence("GNGST,092725.00,,,,,0.014,0.012,0.03"), sentence("GNGST,092725.20,,,,,2.0,4.0,5.0")
    single, single_later = fix(1, time="092725.20"), fix(1, time="092725.40")
    assert deviation(fix(4), fine, fix(4, time="092725.20")) == 0.014
    assert deviation(fix(4), fine, single) == pytest.approx(3.0 * 1.01)
    assert deviation(fix(4), fine, single, single_later) == pytest.approx(3.0 * 1.01)
    assert deviation(fix(4), fine, fix(0, time="092725.20"), fix(4, time="092725.40")) == pytest.approx(0.02 * 1.01)
    assert deviation(fix(4), fine, rough, single) == deviation(fix(4), fine, single, rough, single_later) == 4.0


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_a_heading_goes_with_the_position_of_the_same_burst(order):
    """Clockwise from north; the position is given as soon as it is clear that no heading comes."""
    fixes = Fixes()
    # That there are headings at all is known from the first on.
    fixes.add_line(HDT, NOW_NS - 200_000_000)
    lines = [(GGA_ALONE, NOW_NS + order[0] * 10_000_000), (HDT, NOW_NS + order[1] * 10_000_000)]
    found = [pose for line, at in sorted(lines, key=lambda one: one[1]) for pose in poses(fixes.add_line(line, at))]
    (pose,) = found
    assert pose["yaw_rad"] == pytest.approx(math.radians(90.0 - 123.456))
    assert pose["yaw_std_rad"] == 0.02
    assert poses(fixes.add_line(GGA_ALONE, NOW_NS + 10**9)) == []
    assert fixes.flush(NOW_NS + 10**9 + 10_000_000) == []
    (bare,) = fixes.flush(NOW_NS + 10**9 + 70_000_000)
    assert "yaw_rad" not in bare


def epochs(position_hz, heading_hz, heading_ms, seconds=2):
    """Return the poses of a receiver whose headings, 1 degree per 10 ms, come `heading_ms` after their positions."""
    fixes, lines = Fixes(), []
    for k in range(position_hz * seconds):
        at_ms = 1000 * k // position_hz
        lines.append((at_ms, gga(at_ms / 1000, 47.0, 8.0)))
        if k % (position_hz // heading_hz) == 0:
            lines.append((at_ms + heading_ms, sentence(f"GNHDT,{at_ms / 10:.1f},T")))
    found = []
    for at_ms, line in sorted(lines):
        found += fixes.add_line(line, NOW_NS + at_ms * 1_000_000)
    return poses(found + fixes.flush(NOW_NS + 10**10))


@pytest.mark.parametrize(
    ("position_hz", "heading_hz", "heading_ms"),
    [
        (20, 1, 2), (20, 5, 2), (20, 20, 2), (10, 10, 2), (10, 10, 45), (10, 10, -10), (20, 20, -10), (5, 1, 30),
        # GGA alone takes 22 ms at 38 400 baud.
        (5, 5, -22), (10, 10, -45),
    ],
)  # fmt: skip
def test_no_position_is_lost_and_each_heading_goes_with_the_position_of_its_epoch(position_hz, heading_hz, heading_ms):
    found = epochs(position_hz, heading_hz, heading_ms)
    at_s = [round((pose["t_ns"] - found[0]["t_ns"]) * 1e-9, 3) for pose in found]
    assert at_s == [k / position_hz for k in range(2 * position_hz)]
    with_heading = {at: pose["yaw_rad"] for at, pose in zip(at_s, found, strict=True) if "yaw_rad" in pose}
    # The first position does not wait, as no heading was seen yet.
    assert len(with_heading) >= 2 * heading_hz - 1
    for at, yaw_rad in with_heading.items():
        assert math.remainder(yaw_rad - math.radians(90.0 - 100.0 * at), math.tau) == pytest.approx(0.0, abs=1e-9)


def test_a_lost_heading_does_not_shift_those_after_it():
    fixes, found = Fixes(), []
    for k in range(20):
        at_ms = 50 * k
        if k != 8:
            found += fixes.add_line(sentence(f"GNHDT,{k}.0,T"), NOW_NS + (at_ms - 10) * 1_000_000)
        found += fixes.add_line(gga(at_ms / 1000, 47.0, 8.0), NOW_NS + at_ms * 1_000_000)
    headings = [pose.get("yaw_rad") for pose in poses(found + fixes.flush(NOW_NS + 10**10))]
    assert headings == pytest.approx([None if k == 8 else math.radians(90.0 - k) for k in range(20)], abs=1e-9)


def test_a_fix_has_the_receivers_time_and_not_the_moods_of_the_line():
    clock = ReceiverClock()
    delays_s = [0.15, 0.05, 0.30, 0.05, 0.80, 0.06]
    found = [
        clock.host_ns(100.0 + 0.2 * k, round(1e9 * (7.0 + 0.2 * k + delay_s))) for k, delay_s in enumerate(delays_s)
    ]
    # All as late as the least late one, once that was seen.
    assert found[1:] == [pytest.approx(1e9 * (7.05 + 0.2 * k), abs=10) for k in range(1, 6)]
    # Over midnight, and over a receiver that has found its time anew.
    night = ReceiverClock()
    night.host_ns(86_399.8, 10**9)
    assert night.host_ns(0.0, 10**9 + 350_000_000) == pytest.approx(10**9 + 200_000_000, abs=10)
    assert night.host_ns(18.0, 2 * 10**9) == 2 * 10**9


@pytest.mark.parametrize("period_s", [0.1, 1.0])
@pytest.mark.parametrize("start_s", [43_200.0, 86_395.0])
def test_the_receivers_time_is_used_at_every_rate_and_over_midnight_and_a_silence(period_s, start_s):
    clock = ReceiverClock()
    times_s = [period_s * k for k in (*range(10), *range(20, 30))]
    delays_s = [0.02, *([0.08, 0.41, 0.7, 0.03] * 5)]
    for time_s, delay_s in zip(times_s, delays_s, strict=False):
        found_ns = clock.host_ns((start_s + time_s) % 86_400.0, round(1e9 * (100.0 + time_s + delay_s)))
        assert found_ns == pytest.approx(1e9 * (100.02 + time_s), abs=10)


@pytest.mark.parametrize("step_s", [18.0, -1.0, -3.0])
def test_a_receiver_that_finds_its_time_anew_is_followed_at_once(step_s):
    clock = ReceiverClock()
    for k in range(5):
        clock.host_ns(50_000.0 + k, round(1e9 * (100.05 + k)))
    for k in range(5, 10):
        found_ns = clock.host_ns(50_000.0 + step_s + k, round(1e9 * (100.10 + k)))
        assert found_ns == pytest.approx(1e9 * (100.10 + k), abs=10)


def opened(source):
    """Wait until it listens: what came before the port was open is thrown away."""
    receive_until(source, lambda _, messages: any(message.endswith(": open") for message in messages))


def test_a_position_that_comes_while_a_tick_reads_is_not_lost():
    """It is stamped after the tick's time, by as much as the tick was held up before it read."""
    ours, readers = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    ours.setblocking(False)
    source = NmeaPoses(ours, subprocess.Popen(["true"]))
    tick_ns = time.monotonic_ns()
    (position,) = poses(Fixes().add_line(GGA_ALONE, time.monotonic_ns()))
    readers.send(json.dumps(position).encode())
    (found,) = source.receive(tick_ns, ())
    assert found.t_ns == position["t_ns"] > tick_ns
    assert found.t_ns <= found.received_ns <= time.monotonic_ns()
    source.close()
    readers.close()


def test_over_a_serial_port_that_goes_away(create_source):
    master, slave = os.openpty()
    tty.setraw(slave)
    source = create_source("nmea", device=os.ttyname(slave), baud=115_200)
    _, messages = receive_until(source, lambda _, messages: messages)
    assert messages[0].endswith(": open")
    os.write(master, b"half a line*00\r\n" + GGA_ALONE)
    (pose,), messages = receive_until(source, lambda found, _: found)
    assert (pose.x_m, pose.y_m, pose.has_heading) == (0.0, 0.0, False)
    assert 0 <= time.monotonic_ns() - pose.t_ns < 60 * 10**9
    assert any("fix quality 1" in message for message in messages)
    os.close(slave)
    os.close(master)
    _, messages = receive_until(source, lambda _, messages: messages)
    assert "trying again until it is there" in messages[-1]


def test_over_tcp_with_a_server_that_comes_late_and_sends_garbage(create_source):
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
        source = create_source("nmea", device=f"socket://127.0.0.1:{port}", datum=(47.0, 8.5))
        receiver, _ = server.accept()
        opened(source)
        with receiver:
            receiver.sendall(bytes(range(256)) * 20 + b"\n" + GGA_ALONE)
            (pose,), _ = receive_until(source, lambda found, _: found)
        assert (pose.x_m, pose.y_m) != (0.0, 0.0)
        receive_until(source, lambda _, messages: any("trying again" in message for message in messages))
        again, _ = server.accept()
        opened(source)
        with again:
            again.sendall(gga(40_000.0, 47.0, 8.5))
            (pose,), _ = receive_until(source, lambda found, _: found)
            assert (pose.x_m, pose.y_m) == pytest.approx((0.0, 0.0), abs=1e-3)


def test_a_binary_block_before_a_sentence_costs_no_position(create_source):
    """Receivers mix UBX, SBF or RTCM with NMEA; those end with no newline, and may hold a dollar sign."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        source = create_source("nmea", device=f"socket://127.0.0.1:{server.getsockname()[1]}")
        receiver, _ = server.accept()
        opened(source)
        with receiver:
            for k in range(5):
                receiver.sendall(b"\xb5\x62\x01$\x07" + bytes(range(128, 228)) + gga(0.2 * k, 47.0, 8.5))
            found, _ = receive_until(source, lambda found, _: len(found) == 5)
    assert len(found) == 5


def test_binary_data_alone_is_no_sentence(monkeypatch):
    monkeypatch.setattr("drivers.pose.nmea._SILENT_S", 0.05)
    master, slave = os.openpty()
    tty.setraw(slave)
    for _, text in _lines(os.ttyname(slave), 115_200):
        if text is None:
            os.write(master, b"\xb5$\x07\x01\x02\n")
        elif "no NMEA sentence" in text:
            break
    os.close(slave)
    os.close(master)


def test_over_tcp_a_receiver_that_falls_silent_is_connected_to_again(monkeypatch):
    """One that lost its power says nothing, and knows nothing of its old connection afterwards."""
    monkeypatch.setattr("drivers.pose.nmea._SILENT_S", 0.1)
    monkeypatch.setattr("drivers.pose.nmea._RETRY_S", (0.0,))
    with socket.create_server(("127.0.0.1", 0)) as server, ExitStack() as connections:
        device = f"socket://127.0.0.1:{server.getsockname()[1]}"
        lines = _lines(device, 115_200)
        assert next(lines) == (b"", f"{device}: open")
        connections.enter_context(server.accept()[0])
        (text,) = messages_until(lines, 1)
        assert text == f"{device}: no NMEA sentence for 0 s; connecting again; check the receiver"
        server.setblocking(False)
        for _, text in lines:
            with suppress(BlockingIOError):
                connections.enter_context(server.accept()[0]).sendall(GGA_ALONE)
            if text is not None:
                break
        assert text == f"{device}: NMEA sentences received again"


def test_a_serial_port_that_falls_silent_stays_open(monkeypatch):
    monkeypatch.setattr("drivers.pose.nmea._SILENT_S", 0.05)
    master, slave = os.openpty()
    tty.setraw(slave)
    lines = _lines(os.ttyname(slave), 115_200)
    next(lines)
    (text,) = messages_until(lines, 1)
    assert text.endswith(": no NMEA sentence for 0 s; check the receiver and pose.baud")
    # Were it opened again, this would be thrown away.
    os.write(master, GGA_ALONE)
    assert messages_until(lines, 1)[0].endswith(": NMEA sentences received again")
    assert messages_until(lines, 1)[0].endswith(": no NMEA sentence for 0 s; check the receiver and pose.baud")
    os.close(slave)
    os.close(master)


def messages_until(lines, count):
    """Return the next messages of the port's reader; what it reads is left out."""
    return list(itertools.islice((text for _, text in itertools.islice(lines, 1000) if text is not None), count))


def test_a_reader_that_is_killed_is_said_and_one_whose_daemon_has_gone_ends(create_source):
    # Of a serial port: one over TCP would be connected to anew after 3 s without a sentence.
    stack = simulated_stack(NoPlanner())
    master, slave = os.openpty()
    tty.setraw(slave)
    source = create_source("nmea", device=os.ttyname(slave))
    stack.core.pose_source = source
    opened(source)
    os.write(master, GGA_ALONE)
    receive_until(source, lambda found, _: found)
    os.kill(source._process.pid, signal.SIGKILL)
    source._process.wait(60.0)
    (tick, *_) = [tick for tick in stack.run(0.1) if any("has ended" in event for event in tick.events)]
    assert "poses: the process that reads the GPS receiver has ended; restart the daemon" in tick.events
    assert stack.run(1.0)[-1].pipeline.estimate.pose_ok is False
    os.close(slave)
    os.close(master)
    orphan = create_pose_source("nmea", device="/dev/does/not/exist")
    orphan._socket.close()
    assert orphan._process.wait(60.0) == 0


def test_without_a_device_it_says_what_to_write():
    with pytest.raises(PoseSourceError, match=r'no device; write pose\.device = "/dev/serial'):
        create_pose_source("nmea")


def sentence(text):
    """Return an NMEA sentence with its checksum."""
    checksum = 0
    for byte in text.encode():
        checksum ^= byte
    return f"${text}*{checksum:02X}\r\n".encode()


def fix(quality, altitude="499.6", talker="GN", time="092725.00", place="4717.11399,N,00833.91590,E"):
    return sentence(f"{talker}GGA,{time},{place},{quality},08,1.01,{altitude},M,48.0,M,,")


def messages_of(found):
    return [each["said"] for each in found if "said" in each]


def parsed(*lines):
    """Return what is made of sentences that come 10 ms apart."""
    fixes = Fixes()
    return [each for k, line in enumerate(lines) for each in fixes.add_line(line, NOW_NS + 10_000_000 * k)]


@pytest.mark.parametrize("quality", QUALITY_STD_M)
def test_a_fix_without_an_altitude_is_a_position_and_said_once(quality):
    found = parsed(fix(quality, ""), fix(quality, ""), fix(quality), fix(quality, ""), fix(quality, ""))
    assert [(pose["x_m"], pose["y_m"]) for pose in poses(found)] == [pytest.approx((0.0, 0.0), abs=1e-6)] * 5
    assert [message for message in messages_of(found) if "altitude" in message] == [
        "GGA sentences lack an altitude; used instead: 0 m",
        "GGA sentences lack an altitude; used instead: the last height, 547.6 m",
    ]


@pytest.mark.parametrize("broken", [{"time": ""}, {"place": ",,,"}])
def test_a_fix_without_time_or_place_is_no_position_and_said_once(broken):
    found = parsed(fix(4, **broken), fix(4, **broken))
    assert poses(found) == []
    assert messages_of(found)[1:] == ["GGA sentences lack time, latitude or longitude and give no position"]


@pytest.mark.parametrize("talker", ["GP", "GN", "GL", "GA", "GB", "BD", "GQ"])
@pytest.mark.parametrize("heading", ["HDT,123.456,T", "THS,123.456,A"])
def test_a_heading_of_any_talker_is_read(talker, heading):
    (pose,) = poses(parsed(sentence(talker + heading), fix(4, talker=talker)))
    assert pose["yaw_rad"] == pytest.approx(math.radians(90.0 - 123.456))
    assert pose["yaw_std_rad"] == 0.02


@pytest.mark.parametrize(
    ("ths", "why"),
    [("THS,123.4,V", "not valid"), ("THS,123.4,E", "reckoned"), ("THS,123.4,M", "entered by hand"),
     ("THS,123.4,S", "simulated"), ("THS,,V", "not valid"), ("THS,123.4,", "unknown mode")],
)  # fmt: skip
def test_a_heading_that_the_receiver_does_not_measure_is_refused_and_said_once(ths, why):
    found = parsed(sentence("GN" + ths), fix(4), sentence("GN" + ths), fix(4))
    assert ["yaw_rad" in pose for pose in poses(found)] == [False, False]
    (refusal,) = [message for message in messages_of(found) if message.startswith("THS")]
    assert why in refusal
    assert "not used" in refusal
    again = parsed(sentence("GN" + ths), sentence("GNTHS,123.4,A"), fix(4))
    assert "THS: the heading is measured again" in messages_of(again)
    assert "yaw_rad" in poses(again)[0]


@pytest.mark.parametrize("ths", ["GNTHS,400.0,A", "GNTHS,-3.0,A", "GNTHS,,A", "GNHDT,,T", "GNHDT,361.0,T"])
def test_what_is_no_heading_is_none(ths):
    assert ["yaw_rad" in pose for pose in poses(parsed(sentence(ths), fix(4)))] == [False]
    assert poses(parsed(sentence("GNTHS,123.4,A").replace(b"123", b"124"), fix(4)))[0].keys().isdisjoint({"yaw_rad"})


@pytest.mark.parametrize("heading", [sentence("GPHDT,123.4,T"), sentence("GNTHS,123.4,A")], ids=["HDT", "THS"])
@pytest.mark.parametrize(("quality", "std_rad"), [(1, 0.02), (2, 0.02), (4, 0.02), (5, 0.4)])
def test_the_heading_of_a_float_fix_is_wide_before_or_after_its_position(heading, quality, std_rad):
    (first,) = poses(parsed(heading, fix(quality)))
    # The first position without a heading is not kept waiting; from then on it is known that there are some.
    after = poses(parsed(heading, fix(4), *[sentence("GNZDA,,,,,,")] * 9, fix(quality), heading))[-1]
    assert first["yaw_std_rad"] == after["yaw_std_rad"] == std_rad


def test_the_heading_that_came_without_a_fix_is_wide():
    (pose,) = poses(parsed(fix(0), sentence("GPHDT,123.4,T"), fix(4)))
    assert pose["yaw_std_rad"] == 0.4


def test_where_no_heading_comes_the_sentences_that_bring_one_are_named_once():
    def messages_over(seconds, *first):
        fixes = Fixes()
        found = [each for line in first for each in fixes.add_line(line, NOW_NS)]
        found += [each for k in range(5 * seconds) for each in fixes.add_line(fix(4), NOW_NS + 200_000_000 * (k + 1))]
        return [message for message in messages_of(found) if "HDT or THS" in message]

    assert len(messages_over(30)) == 1
    assert messages_over(9) == []
    assert messages_over(30, HDT) == []


@pytest.mark.parametrize("heading", [HDT, sentence("GNTHS,123.4,A")], ids=["HDT", "THS"])
def test_each_loss_of_the_heading_is_reported_and_its_return(heading):
    fixes, found = Fixes(), []
    for k in range(5 * 60):
        at_ns = NOW_NS + 200_000_000 * k
        found += fixes.add_line(fix(4), at_ns)
        # It comes for 10 s, is away for 20 s, and comes for 5 s; then it stays away.
        if k < 50 or 150 <= k < 175:
            found += fixes.add_line(heading, at_ns + 1_000_000)
    lost, back = "no heading for 10 s; positions only", "headings received again"
    assert [message for message in messages_of(found) if "heading" in message] == [lost, back, lost]
