"""Long status texts are one line again."""

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from sitl.ground.vehicle_record import TextLog

LONG = "not sent: vision yaw differs from the autopilot's by +5.1 deg, and this line goes on"


def _taken(*messages):
    codec, log = mavlink.MAVLink(None, 1, 191), TextLog()
    for k, (message, component) in enumerate(messages):
        codec.srcComponent = component
        decoded = mavlink.MAVLink(None).parse_char(message.pack(codec))
        log.add(decoded, k)
    return [(line.text, line.component, line.time_ns) for line in log.lines]


def _chunks(text, number, component=191):
    raw = text.encode()
    parts = [raw[i : i + 50] for i in range(0, len(raw), 50)] + [b""] * (len(raw) % 50 == 0)
    made = mavlink.MAVLink_statustext_message
    if len(parts) == 1:
        return [(made(6, raw), component)]
    return [(made(6, part, number, i), component) for i, part in enumerate(parts)]


def test_chunks_of_two_components_are_joined_each_to_its_own():
    ours, theirs = _chunks(LONG, 7), _chunks("x" * 120, 7, component=1)
    assert len(ours) == 2
    assert len(theirs) == 3
    short = _chunks("armed", 8, component=1)
    assert _taken(ours[0], theirs[0], ours[1], theirs[1], theirs[2], *short) == [
        (LONG, 191, 0), ("x" * 120, 1, 1), ("armed", 1, 5)
    ]  # fmt: skip


def test_a_text_that_fills_its_chunks_and_the_next_under_the_same_id():
    assert _taken(*_chunks("y" * 100, 3), *_chunks(LONG, 3)) == [
        ("y" * 100, 191, 0), (LONG, 191, 3)
    ]  # fmt: skip


def test_what_is_lost_leaves_dots():
    three = _chunks("a" * 50 + "b" * 50 + "c", 4)
    assert _taken(three[0], three[2]) == [("a" * 50 + "...c", 191, 0)]
    assert _taken(three[1], three[2]) == [("..." + "b" * 50 + "c", 191, 0)]
    # The next text of the same id begins a line of its own, whatever is missing before it.
    assert _taken(three[0], *_chunks("again", 4)) == [("a" * 50, 191, 0), ("again", 191, 1)]
