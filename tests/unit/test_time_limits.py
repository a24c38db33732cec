"""The limit that fuzz tests set: it ends what hangs and leaves no alarm behind."""

from __future__ import annotations

import signal
import time

import pytest

from time_limits import time_limit


def test_what_hangs_is_ended_and_what_does_not_is_left_alone() -> None:
    before = signal.getsignal(signal.SIGALRM)
    with time_limit(5):
        pass
    assert signal.alarm(0) == 0
    with pytest.raises(TimeoutError, match="1 s"), time_limit(1):
        time.sleep(5)
    assert signal.getsignal(signal.SIGALRM) == before
