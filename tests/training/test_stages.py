"""Long actions say how far they are, and the first signal ends what keeps nothing."""

import signal
import subprocess
import sys

import pytest

from midway.training.progress import showing_stages, stage

PROGRAM = """
import hashlib, os, sys, threading
from midway.training.signals import ending_soon
with ending_soon(grace=0.2):
    threading.Timer(1.0, os.kill, (os.getpid(), int(sys.argv[1]))).start()
    hashlib.pbkdf2_hmac("sha256", b"native", b"code", 10**9)
"""
"""Signals itself once native code runs, which lets Python's other threads run."""


def test_stages_are_lines_where_there_is_no_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    stage("decoder", 0, 3)
    with showing_stages():
        stage("decoder", 1, 3)
    stage("decoder", 2, 3)
    assert capsys.readouterr().err == "decoder: 1 of 3\n"


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_first_signal_ends_native_code_too(number: signal.Signals) -> None:
    command = [sys.executable, "-c", PROGRAM, str(int(number))]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 128 + number
    assert done.stderr == "midway: interrupted\n"
