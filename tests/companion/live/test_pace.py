"""The rate of pictures on the page is the one that was asked for."""

import pytest

from companion.live.pace import RateLimiter


@pytest.mark.parametrize(("fed_hz", "asked_hz", "sent_hz"), [(10, 6, 6), (10, 15, 10), (30, 6, 6)])
def test_the_mean_rate_is_what_was_asked_for(fed_hz, asked_hz, sent_hz):
    pace, sent = RateLimiter(1.0 / asked_hz), 0
    for i in range(100 * fed_hz):
        if pace.is_due(1000.0 + i / fed_hz):
            pace.mark_sent(1000.0 + i / fed_hz)
            sent += 1
    assert sent / 100 == pytest.approx(sent_hz, rel=0.02)
