import threading

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
