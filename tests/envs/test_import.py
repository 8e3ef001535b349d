"""``import midway`` registers the environments without loading what is slow."""

import subprocess
import sys

SCRIPT = """
import sys, gymnasium, midway
assert not {"jax", "mujoco", "scipy"} & set(sys.modules), "slow imports"
assert "midway/AntMaze-Omega-v0" in gymnasium.registry
assert midway.make_vec("point-u", num_envs=2).num_envs == 2
try:
    midway.nothing
except AttributeError as error:
    assert "nothing" in str(error)
"""


def test_import_is_light_and_registers():
    subprocess.run([sys.executable, "-W", "error", "-c", SCRIPT], check=True)
