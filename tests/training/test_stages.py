"""Long actions say how far they are, and the first signal ends what keeps nothing."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from midway.training.progress import showing_stages, stage

PROGRAM = """
import hashlib, os, sys, threading
from midway.training import signals
signals.GRACE = 0.2 if len(sys.argv) == 3 else 1000
with {context}:
    for number in sys.argv[2:]:
        threading.Timer(1.0, os.kill, (os.getpid(), int(number))).start()
    hashlib.pbkdf2_hmac("sha256", b"native", b"code", 10**9)
"""
"""Signals itself once native code runs, which lets Python's other threads run."""

COMPILING = """
import sys
from midway.cli.main import main
from midway.training import signals
signals.GRACE = 0.2
main(["train", "point-u", "--out", sys.argv[1], "--set", "steps=4000", "evaluation_episodes=1"])
"""
"""A run that has to compile its update, which takes XLA seconds."""

COMMAND = "signals.ending_soon(grace=0.2)"
RUN = "signals.ending_in_time(), signals.listening()"


def test_stages_are_lines_where_there_is_no_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    stage("decoder", 0, 3)
    with showing_stages():
        stage("decoder", 1, 3)
    stage("decoder", 2, 3)
    assert capsys.readouterr().err == "decoder: 1 of 3\n"


@pytest.mark.parametrize(
    ("context", "numbers"),
    [
        (COMMAND, [signal.SIGINT]),
        (COMMAND, [signal.SIGTERM]),
        (RUN, [signal.SIGINT]),
        (RUN, [signal.SIGTERM]),
        (RUN, [signal.SIGINT, signal.SIGTERM]),  # the second one is obeyed sooner
    ],
)
def test_signals_end_native_code_too(context: str, numbers: list[signal.Signals]) -> None:
    program = PROGRAM.format(context=context)
    command = [sys.executable, "-c", program, "--", *(str(int(number)) for number in numbers)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode in [128 + number for number in numbers]
    assert done.stderr == "midway: interrupted\n"


def test_a_signal_ends_a_run_while_its_update_is_compiled(tmp_path: Path) -> None:
    run = tmp_path / "run"
    says = {"JAX_LOG_COMPILES": "1", "XDG_CACHE_HOME": str(tmp_path)}
    process = subprocess.Popen(
        [sys.executable, "-c", COMPILING, str(run)],
        env=os.environ | says,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stderr is not None
    with process:
        for line in process.stderr:
            if "Compiling jit(train)" in line:
                process.send_signal(signal.SIGTERM)
                break
        rest = process.stderr.read()
    assert process.returncode == 128 + signal.SIGTERM
    assert "Finished XLA compilation of jit(train)" not in rest
    assert rest.splitlines()[-1].startswith("midway: interrupted in the middle of a step; ")
    assert (run / "config.json").exists()
