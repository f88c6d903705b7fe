"""Parameters, mission protocol, gimbal reports and routing, message by message."""

from __future__ import annotations

import contextlib
import fcntl
import math
import socket
import struct
import termios
import time

import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sitl.embedded.__main__ import main
from sitl.embedded.control.mission import MissionStore
from sitl.embedded.mavlink.server import MavlinkServer
from sitl.embedded.parameters import Parameters, read_parameter_file
from sitl.embedded.physics.gimbal import Gimbal
from sitl.embedded.physics.rotation import euler
from sitl.embedded.vehicle import EmbeddedVehicle
from sitl.errors import ParameterFileError, PortError
from sitl.geodesy import Location

HERE = Location(47.0, 8.0, 500.0)


# --- parameters --------------------------------------------------------------------------------


def test_reads_parameter_files_with_blanks_commas_and_comments(tmp_path):
    path = tmp_path / "a.parm"
    path.write_text("# a comment\nVISO_TYPE 1\nWPNAV_SPEED,500 # slow\n\nRTL_ALT\t3000\n")
    assert read_parameter_file(path) == {"VISO_TYPE": 1, "WPNAV_SPEED": 500, "RTL_ALT": 3000}


@pytest.mark.parametrize("line", ["VISO_TYPE", "VISO_TYPE one"])
def test_names_the_line_of_a_bad_parameter_file(tmp_path, line):
    path = tmp_path / "bad.parm"
    path.write_text(f"RTL_ALT 1\n{line}\n")
    with pytest.raises(ParameterFileError, match=r"bad\.parm, line 2"):
        read_parameter_file(path)


def test_a_missing_parameter_file_ends_the_process_with_a_message(tmp_path, capsys):
    status = main(["--home=47,8,500,0", f"--params={tmp_path / 'none.parm'}"])
    assert status == 1
    assert "none.parm" in capsys.readouterr().err


@pytest.mark.parametrize("home", ["47,8,500", "here", "120,8,500,0"])
def test_a_bad_home_is_refused(home, capsys):
    with pytest.raises(SystemExit):
        main([f"--home={home}"])
    assert "--home" in capsys.readouterr().err


# --- mission protocol --------------------------------------------------------------------------


class Replies(list):
    def send(self, message):
        self.append(message)


def sent_by_gcs(message):
    message.pack(mavlink.MAVLink(None, 255, 190))  # which names the sender
    return message


def mission_item(seq, command=16, lat=470000000, lon=80000000, alt=50.0):
    return sent_by_gcs(
        mavlink.MAVLink_mission_item_int_message(
            1, 1, seq, 3, command, 0, 1, 0, 0, 0, 0, lat, lon, alt
        )
    )


def upload(store, commands):
    replies = Replies()
    store.handle(sent_by_gcs(mavlink.MAVLink_mission_count_message(1, 1, len(commands))), replies)
    for seq, command in enumerate(commands):
        assert replies[-1].get_type() == "MISSION_REQUEST_INT"
        assert replies[-1].seq == seq
        store.handle(mission_item(seq, command, lat=470000000 + seq), replies)
    return replies


def test_a_command_the_vehicle_cannot_fly_is_refused_and_keeps_the_old_mission():
    store = MissionStore()
    upload(store, [16, 22])
    replies = Replies()
    store.handle(sent_by_gcs(mavlink.MAVLink_mission_count_message(1, 1, 2)), replies)
    store.handle(mission_item(0), replies)
    store.handle(mission_item(1, command=31000), replies)
    assert replies[-1].type == mavlink.MAV_MISSION_UNSUPPORTED
    assert len(store.items) == 2


def test_clears_the_mission_and_has_no_fence():
    store, replies = MissionStore(), Replies()
    upload(store, [16, 22])
    store.handle(sent_by_gcs(mavlink.MAVLink_mission_clear_all_message(1, 1)), replies)
    assert store.items == []
    fence = sent_by_gcs(mavlink.MAVLink_mission_request_list_message(1, 1, 1))
    store.handle(fence, replies)
    assert (replies[-1].count, replies[-1].mission_type) == (0, 1)


# --- gimbal ------------------------------------------------------------------------------------


def settle(gimbal, yaw=0.0, seconds=5.0):
    for _ in range(round(seconds * 100)):
        gimbal.update(HERE, yaw, 0.01)


def test_the_report_is_always_in_the_vehicle_frame():
    gimbal = Gimbal(Parameters({"MNT1_TYPE": 7}))
    gimbal.point(-60.0, 20.0, yaw_locked=False)
    settle(gimbal)
    roll, pitch, yaw = (math.degrees(a) for a in euler(gimbal.attitude))
    assert (roll, pitch, yaw) == pytest.approx((0.0, -60.0, 20.0), abs=1e-6)
    assert gimbal.flags == 4 | 8 | 32
    gimbal.point(-30.0, 90.0, yaw_locked=True)
    settle(gimbal, yaw=math.radians(30))
    assert math.degrees(euler(gimbal.attitude)[2]) == pytest.approx(60.0)
    assert gimbal.flags == 4 | 8 | 16 | 32


def test_the_gimbal_moves_at_a_finite_rate_within_its_limits():
    gimbal = Gimbal(Parameters({"MNT1_TYPE": 7}))
    gimbal.point(-90.0, 0.0, yaw_locked=False)
    settle(gimbal, seconds=0.5)
    assert math.degrees(gimbal.pitch_rad) == pytest.approx(-30.0, abs=1.0)
    gimbal.point(80.0, 0.0, yaw_locked=False)
    settle(gimbal)
    assert math.degrees(gimbal.pitch_rad) == pytest.approx(20.0)


def test_a_servo_gimbal_reports_angles_less_the_lean():
    """Seen on ArduPilot 4.7: MNT1_TYPE 1 at pitch -60 reports -40 while the nose is down 20."""
    gimbal = Gimbal(Parameters({"MNT1_TYPE": 1}))
    gimbal.point(-60.0, 0.0, yaw_locked=False)
    settle(gimbal)
    reported = euler(gimbal.reported(0.0, math.radians(-20.0)))
    assert math.degrees(reported[1]) == pytest.approx(-40.0)
    assert math.degrees(euler(gimbal.attitude)[1]) == pytest.approx(-60.0)


# --- links and routing -------------------------------------------------------------------------


class Client:
    """A MAVLink component on one of the vehicle's ports."""

    def __init__(self, port, system, component):
        self.socket = socket.create_connection(("127.0.0.1", port))
        self.socket.setblocking(False)
        self.mav = mavlink.MAVLink(None, srcSystem=system, srcComponent=component)
        self.mav.robust_parsing = True

    def send(self, message):
        self.socket.sendall(message.pack(self.mav))

    def received(self):
        data = bytearray()
        with contextlib.suppress(BlockingIOError):
            while chunk := self.socket.recv(1 << 20):
                data += chunk
        return self.mav.parse_buffer(bytes(data)) or []


def delivered(socket_):
    """Wait until all that was sent lies in the receiver's buffer: nothing is unacknowledged."""
    until = time.monotonic() + 30.0
    while struct.unpack("i", fcntl.ioctl(socket_, termios.TIOCOUTQ, b"\0\0\0\0"))[0]:
        assert time.monotonic() < until
        time.sleep(0.001)


@pytest.fixture
def linked():
    server = MavlinkServer((0, 0), 1)  # any ports that are free
    ports = [link.listener.getsockname()[1] for link in server.links]
    vehicle = EmbeddedVehicle(HERE, 0.0, Parameters({"MNT1_TYPE": 7}), server)
    gcs, companion = Client(ports[0], 255, 190), Client(ports[1], 1, 191)

    def run(ticks=30):
        for client in (gcs, companion):  # simulated time does not wait
            delivered(client.socket)
        for _ in range(ticks):
            vehicle.step()
        for link in server.links:
            if link.client is not None:
                delivered(link.client)
        return gcs.received(), companion.received()

    run(3)
    yield vehicle.aircraft, gcs, companion, run
    server.close()


HEARTBEAT = mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3)
REPORT = mavlink.MAVLink_named_value_float_message(1, b"x", 1.0)


def kinds(messages, component):
    return [m.get_type() for m in messages if m.get_srcComponent() == component]


def test_a_stream_interval_holds_in_simulated_time(linked):
    _, gcs, _, run = linked
    sim_state = mavlink.MAVLINK_MSG_ID_SIM_STATE
    gcs.send(mavlink.MAVLink_command_long_message(1, 1, 511, 0, sim_state, 20_000, 0, 0, 0, 0, 0))
    run(10)
    to_gcs, to_companion = run(200)
    assert kinds(to_gcs, 1).count("SIM_STATE") == pytest.approx(100, abs=2)
    assert "SIM_STATE" not in kinds(to_companion, 1)


def test_nothing_is_routed_to_a_ground_station_that_has_not_spoken(linked):
    _, gcs, companion, run = linked
    companion.send(HEARTBEAT)
    companion.send(REPORT)
    to_gcs, _ = run()
    assert kinds(to_gcs, 191) == []
    gcs.send(HEARTBEAT)
    run()
    companion.send(REPORT)
    to_gcs, _ = run()
    assert kinds(to_gcs, 191) == ["NAMED_VALUE_FLOAT"]


def test_addressed_messages_go_where_their_target_was_heard(linked):
    _, gcs, companion, run = linked
    gcs.send(HEARTBEAT)
    companion.send(HEARTBEAT)
    run()
    track_point = mavlink.MAV_CMD_CAMERA_TRACK_POINT
    to_camera = mavlink.MAVLink_command_long_message(1, 191, track_point, 0, *[0.5] * 7)
    gcs.send(to_camera)
    to_gcs, to_companion = run()
    assert "COMMAND_LONG" in kinds(to_companion, 190)
    assert "COMMAND_ACK" not in kinds(to_gcs, 1)  # the autopilot leaves it to the component
    gcs.send(mavlink.MAVLink_command_long_message(1, 1, 512, 0, 148, 0, 0, 0, 0, 0, 0))
    to_gcs, to_companion = run()
    assert "AUTOPILOT_VERSION" in kinds(to_gcs, 1)
    assert "COMMAND_LONG" not in kinds(to_companion, 190)


def test_parameters_over_mavlink(linked):
    vehicle, gcs, companion, run = linked
    gcs.send(mavlink.MAVLink_param_request_list_message(1, 1))
    to_gcs, _ = run()
    values = {m.param_id: m for m in to_gcs if m.get_type() == "PARAM_VALUE"}
    assert set(values) == set(vehicle.parameters)
    assert values["EK3_SRC1_POSXY"].param_value == 3.0
    assert all(m.param_count == len(values) for m in values.values())
    gcs.send(mavlink.MAVLink_param_set_message(1, 1, b"RTL_ALT", 3000.0, 9))
    to_gcs, to_companion = run()
    for messages in (to_gcs, to_companion):
        changed = [m for m in messages if m.get_type() == "PARAM_VALUE"]
        assert [(m.param_id, m.param_value) for m in changed] == [("RTL_ALT", 3000.0)]
    companion.send(mavlink.MAVLink_param_request_read_message(1, 1, b"RTL_ALT", -1))
    _, to_companion = run()
    assert [m.param_value for m in to_companion if m.get_type() == "PARAM_VALUE"] == [3000.0]


def test_a_port_in_use_is_a_named_error():
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(PortError, match=str(port)):
            MavlinkServer((port,), 1)
