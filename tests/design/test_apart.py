"""Calls in a thread of their own: what they return and raise, and how they end when nobody waits any more."""

import signal
import threading
import time

import pytest
import torch

from torchmask.design.apart import make_apart


def test_no_default_device_is_in_force_and_errors_come_back():
    with torch.device("meta"):
        assert make_apart(torch.zeros, 2).device.type == "cpu"
    with pytest.raises(ZeroDivisionError):
        make_apart(divmod, 1, 0)


def test_an_interruption_ends_the_call_at_once():
    """Ctrl-C reaches the main thread only, which would wait for the other one to its end."""
    ended = []

    def work():
        begun = time.monotonic()
        timer = threading.Timer(0.2, signal.pthread_kill, (threading.main_thread().ident, signal.SIGINT))
        timer.start()
        try:
            while time.monotonic() < begun + 20:
                time.sleep(0.01)
        finally:
            ended.append(time.monotonic() - begun)

    handler = signal.signal(signal.SIGINT, signal.default_int_handler)  # which a worker of a test run ignores
    try:
        with pytest.raises(KeyboardInterrupt):
            make_apart(work)
    finally:
        signal.signal(signal.SIGINT, handler)
    assert ended[0] < 10  # of 20 s
    assert make_apart(int, "3") == 3
