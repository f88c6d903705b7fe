import threading

import pytest

from localizer.tracking.mailbox import Mailbox


def test_newest_wins_and_drops_are_counted():
    box: Mailbox[int] = Mailbox()
    for item in (1, 2, 3):
        box.put(item)
    assert box.take() == 3
    assert box.dropped == 2
    assert box.take(timeout_s=0.01) is None


def test_close_wakes_a_waiting_reader():
    box: Mailbox[int] = Mailbox()
    got = []
    reader = threading.Thread(target=lambda: got.append(box.take()))
    reader.start()
    box.close()
    reader.join(timeout=60)
    assert got == [None]


def test_the_producers_failure_reaches_the_consumer_over_an_item_that_waits():
    box: Mailbox[int] = Mailbox()
    assert box.put(1)
    box.close(ValueError("the stream broke"))
    box.close(RuntimeError("later"))
    with pytest.raises(ValueError, match="the stream broke"):
        box.take()
    assert not box.put(2)
    assert box.dropped == 0
