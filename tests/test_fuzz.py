"""Files of others load, or are refused by an error of midway's own, whatever is in them."""

import subprocess
import sys
from pathlib import Path

FUZZ = Path(__file__).parent / "fuzz.py"


def test_mutated_files_load_or_are_refused() -> None:
    """In a process of its own: types are checked at run time here, and not at a user's."""
    words = [sys.executable, str(FUZZ), "--each", "2000"]
    ended = subprocess.run(words, capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stdout + ended.stderr[-2_000:]
    assert ended.stdout.count("2000 mutants") == 10
