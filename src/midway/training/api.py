"""The Python interface: train, resume, load, evaluate."""

import ast
import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from midway import presets
from midway.agents import registry as agents
from midway.envs import registry as environments
from midway.training import loop
from midway.training import policy as policies
from midway.training.checkpoint import Checkpoints
from midway.training.evaluate import ActionKind, Evaluation, run_episodes
from midway.training.folder import RunConfig, RunFolder
from midway.training.logging import Logger
from midway.training.policy import Policy
from midway.training.progress import Reporter, Silent, reporter
from midway.types import ConfigurationError


@dataclasses.dataclass(frozen=True)
class Run:
    """What a finished or interrupted run leaves.

    Attributes:
        path: The run folder.
        finished: Whether all steps were taken.
    """

    path: Path
    finished: bool


def configure(
    env: str,
    agent: str = "ris",
    preset: str = "quick",
    seed: int = 0,
    changes: Mapping[str, Any] | None = None,
) -> RunConfig:
    """Return a preset with some values changed.

    Args:
        env: Environment name.
        agent: Agent name.
        preset: ``paper`` or ``quick``.
        seed: The one seed of every generator.
        changes: Values by their field names in `TrainConfig` or the agent's ``Config``; text is
            read as Python literals.

    Raises:
        ConfigurationError: A name is unknown or a value has the wrong type.
    """
    environments.entry(env)
    train, hyperparameters = presets.preset(env, agent, preset)
    changes = changes or {}
    allowed = (*_field_names(train), *_field_names(hyperparameters))
    for name in changes:
        if name not in allowed:
            raise ConfigurationError(f"unknown setting {name!r}: use one of {', '.join(allowed)}")
    # All at once: two values may fit each other, and one alone not the preset.
    configs = [_changed(config, changes) for config in (train, hyperparameters)]
    return RunConfig(env, agent, preset, seed, *configs)


def train(
    env: str,
    *,
    agent: str = "ris",
    preset: str = "quick",
    steps: int | None = None,
    seed: int = 0,
    num_envs: int | None = None,
    out: str | Path | None = None,
    precision: str | None = None,
    changes: Mapping[str, Any] | None = None,
    progress: bool = False,
) -> Run:
    """Train an agent on an environment and write a run folder.

    Args:
        env: Environment name.
        agent: ``ris``, ``sac`` and so on.
        preset: ``paper`` or ``quick``.
        steps: Environment steps; default: the preset's.
        seed: The one seed of every generator.
        num_envs: Parallel environments; default: the preset's.
        out: The run folder; default: ``runs/ENV-AGENT-seedN``.
        precision: ``f32`` or ``bf16``; default: the preset's.
        changes: Other settings, as in `configure`.
        progress: Whether to report on standard error.

    Raises:
        ConfigurationError: A name, value or folder cannot be used.
        NonFiniteError: A loss became NaN or infinite; the last good checkpoint is kept.
    """
    named = {"steps": steps, "num_envs": num_envs, "precision": precision}
    given = {name: value for name, value in named.items() if value is not None}
    config = configure(env, agent, preset, seed, {**(changes or {}), **given})
    folder = RunFolder(Path(out or Path("runs") / f"{env}-{agent}-seed{seed}"))
    training = build(config, folder)
    folder.create(config)
    return _run(training, progress)


def resume(
    path: str | Path,
    steps: int | None = None,
    progress: bool = False,
    devices: int | None = None,
) -> Run:
    """Continue a run from its newest whole checkpoint, bit for bit.

    Args:
        path: The run folder.
        steps: New total of environment steps; default: the run's own.
        progress: Whether to report on standard error.
        devices: New number of accelerators, which changes rounding; default: the run's own.

    Raises:
        ConfigurationError: This is no run folder, its checkpoint is damaged or foreign, or the
            machine has fewer devices.
        NonFiniteError: A loss became NaN or infinite.
    """
    folder = RunFolder(Path(path))
    config = folder.load_config()
    named = {"steps": steps, "devices": devices}
    given: dict[str, Any] = {name: int(v) for name, v in named.items() if v is not None}
    config = dataclasses.replace(config, train=dataclasses.replace(config.train, **given))
    training = build(config, folder)
    folder.note_resume(config)
    return _run(training, progress)


def load(path: str | Path) -> Policy:
    """Return the policy of a run: ``policy(observation, goal) -> action``.

    Raises:
        ConfigurationError: The folder holds no policy, or a damaged or foreign one.
    """
    folder = RunFolder(Path(path))
    config = folder.load_config()
    return policies.load(folder, environments.make_vec(config.env).goal_spec)


def evaluate(
    path: str | Path,
    *,
    episodes: int = 100,
    task: str = "hard",
    actions: ActionKind = "mean",
    seed: int = 0,
) -> Evaluation:
    """Run episodes of a trained policy.

    Args:
        path: The run folder.
        episodes: Number of episodes.
        task: ``hard``, ``uniform`` or a named case of the environment.
        actions: ``mean`` or ``sampled``.
        seed: Seed of starts and goals.

    Raises:
        ConfigurationError: The folder, the task or the number of episodes cannot be used.
    """
    if episodes < 1:
        raise ConfigurationError(f"episodes {episodes}: must be at least 1")
    policy = load(path)
    env = environments.make_vec(policy.config.env, num_envs=episodes, task=task)
    # The seeds of training and its evaluations come from a hash; these must not meet them.
    env_seed = int(np.random.SeedSequence((seed, 1)).generate_state(1)[0])
    return run_episodes(env, policy.actor(actions, seed), task, actions, env_seed)


def build(config: RunConfig, folder: RunFolder) -> loop.Training:
    """Return the run of this configuration at its start; nothing is written."""

    def make_env(num_envs: int, task: str) -> Any:
        return environments.make_vec(config.env, num_envs=num_envs, task=task)

    return loop.Training(agents.get(config.agent), config, make_env, folder)


def _run(training: loop.Training, progress: bool) -> Run:
    """Restore the newest checkpoint if there is one, then train."""
    with training.folder.lock():
        return _run_locked(training, progress)


def _run_locked(training: loop.Training, progress: bool) -> Run:
    folder = training.folder
    checkpoints = Checkpoints(folder.checkpoints)
    latest = checkpoints.latest()
    if latest is not None:
        training.restore(checkpoints, latest)
    say: Reporter = reporter(training.config.train.steps, training.steps) if progress else Silent()
    logger = Logger(
        folder.metrics_file, folder.evaluation_file, folder.path / "events", training.steps
    )
    try:
        return Run(folder.path, loop.run(training, checkpoints, logger, say))
    finally:
        say.close()
        logger.close()
        checkpoints.close()


def _field_names(config: Any) -> tuple[str, ...]:
    return tuple(field.name for field in dataclasses.fields(config))


def _changed(config: Any, changes: Mapping[str, Any]) -> Any:
    """Return the dataclass with the values replaced that it has a field for."""
    names = [name for name in changes if name in _field_names(config)]
    return dataclasses.replace(
        config, **{name: _converted(getattr(config, name), name, changes[name]) for name in names}
    )


def _converted(old: Any, name: str, value: Any) -> Any:
    """Return the value in the type of the old one."""
    if isinstance(value, str) and not isinstance(old, str):
        try:
            value = ast.literal_eval(value)
        except (ValueError, SyntaxError):
            raise ConfigurationError(f"{name} {value!r}: not a {type(old).__name__}") from None
    if dataclasses.is_dataclass(old):
        try:
            value = type(old)(*value)  # type: ignore[operator]
        except TypeError:
            raise ConfigurationError(f"{name} {value!r}: one value for each share") from None
    if isinstance(old, float) and isinstance(value, int):
        value = float(value)
    if isinstance(old, int) and isinstance(value, float) and value.is_integer():
        value = int(value)
    if type(value) is not type(old):
        raise ConfigurationError(f"{name} {value!r}: must be a {type(old).__name__}")
    if name == "precision" and value not in ("f32", "bf16"):
        raise ConfigurationError(f"precision {value!r}: choose f32 or bf16")
    return value
