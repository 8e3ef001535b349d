"""Episodes of a few steps, for tests of what happens around them.

``python tests/short.py ARGUMENT...`` is the command line of midway with such episodes.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import pytest

from midway.cli.main import main
from midway.envs.push import PushStateVectorEnv, PushVectorEnv
from midway.envs.registry import ENVIRONMENTS

STEPS = 30
"""Of an episode, instead of 100 to 600: most of the time of a small run are its evaluations."""


@contextmanager
def episodes() -> Iterator[None]:
    """End the episodes of midway's environments after a few steps."""
    with pytest.MonkeyPatch.context() as patch:
        for name, declared in ENVIRONMENTS.items():
            if declared.family != "push":
                arguments = {**declared.arguments, "max_episode_steps": STEPS}
                patch.setitem(ENVIRONMENTS, name, replace(declared, arguments=arguments))
        for push in (PushStateVectorEnv, PushVectorEnv):
            spec = replace(push.spec_of_class, max_episode_steps=STEPS)
            patch.setattr(push, "spec_of_class", spec)
        yield


if __name__ == "__main__":
    with episodes():
        main()
