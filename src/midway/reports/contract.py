"""The contract of HOUSE.md on the API of today; goes away when the contract lands."""

import csv
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple, TypeAlias

import equinox as eqx
import jax
import numpy as np

from midway.agents import registry
from midway.envs import registry as environments
from midway.envs.mazes import MAZES, Maze
from midway.networks.encoder import ImageEncoder
from midway.training import policy as policies
from midway.training.folder import RunFolder
from midway.types import ConfigurationError, Subgoal

Table: TypeAlias = dict[str, np.ndarray[Any, np.dtype[Any]]]
TEXT_COLUMNS = ("task", "actions")


@dataclass(frozen=True)
class MazeView:
    maze: Maze
    upright: tuple[int, int] | None = None
    position = slice(0, 2)


@dataclass(frozen=True)
class TableView:
    hand = slice(0, 2)
    puck = slice(2, 4)


def view(env: str) -> MazeView | TableView | None:
    robot, _, maze = env.partition("-")
    if maze in MAZES:
        return MazeView(MAZES[maze], (5, 7) if robot == "ant" else None)
    return TableView() if env in ("push", "push-state") else None


class SubgoalDistribution(NamedTuple):
    location: Subgoal
    scale: Subgoal


class Moment(NamedTuple):
    observation: Any
    info: Any
    ended: Any
    running: Any


def agent(name: str) -> Any:
    module = registry.get(name)
    subgoals = value = memory = pretrain = freezing = None
    if "subgoal_policy" in module.NETWORKS:

        def subgoals(state: Any, o: Any, g: Any) -> Any:
            found = state.subgoal_policy(state.encoder(o), state.encoder(g))
            location = state.encoder.states(found.location)
            scale = state.spec.unit * jax.numpy.exp(found.log_scale)
            return SubgoalDistribution(
                module.as_subgoal(state.spec, location), module.as_subgoal(state.spec, scale)
            )

    if hasattr(module, "value") or name == "sac":

        def estimate(state: Any, o: Any, g: Any) -> Any:
            pair = state.encoder(o), state.encoder(g)
            if hasattr(module, "value"):
                return module.value(state, *pair)
            return state.critic(pair[0], jax.numpy.tanh(state.policy(*pair).mean), pair[1]).min(0)

        discounted = hasattr(module.Config(), "discount")
        unit = "minus discounted steps to the goal" if discounted else "minus distance at the end"
        value = SimpleNamespace(estimate=estimate, unit=f"value: {unit}")
    if hasattr(module, "subgoal_codes"):

        def plan(state: Any, memory: Any) -> Any:
            return state.encoder.states(module.subgoal_codes(state, memory.latents).achieved_goal)

        def reconstruct(state: Any, states: Any) -> Any:
            return state.vae.decode(state.vae.encode(states.observation).mean)

        memory = SimpleNamespace(plan=plan)
        pretrain = SimpleNamespace(reconstruct=reconstruct)
    if name != "leap":
        freezing = SimpleNamespace(encoder=lambda state: state.encoder)
    return SimpleNamespace(
        subgoals=subgoals, value=value, memory=memory, pretrain=pretrain, freezing=freezing
    )


@dataclass(frozen=True)
class Policy:
    agent: Any
    state: Any
    config: Any
    step: int | None
    encoder: Callable[[Any], Any] | None
    old: Any

    @property
    def spec(self) -> Any:
        return self.state.spec

    def actor(self) -> Any:
        return self.old.actor()

    def features(self, observation: Any) -> Any:
        return (
            observation if self.encoder is None else np.asarray(_apply(self.encoder, observation))
        )

    def value(self, observation: Any, goal: Any) -> Any:
        return np.asarray(_call(self.agent.value.estimate, self.state, observation, goal))

    def subgoals(self, observation: Any, goal: Any) -> SubgoalDistribution:
        found = _call(self.agent.subgoals, self.state, observation, goal)
        return jax.tree.map(np.asarray, found)


@eqx.filter_jit
def _apply(function: Any, x: Any) -> Any:
    return function(x)


@eqx.filter_jit
def _call(function: Any, state: Any, o: Any, g: Any) -> Any:
    return function(state, o, g)


@dataclass(frozen=True)
class _Folder(RunFolder):
    weights: Path = Path()

    @property
    def policy_weights(self) -> Path:
        return self.weights


def load(folder: RunFolder, weights: Path | None = None) -> Policy:
    old_folder = folder if weights is None else _Folder(folder.path, weights)
    env = folder.load_config().env
    old = policies.load(old_folder, environments.make_vec(env).goal_spec)
    encoder = getattr(old.state, "encoder", None)
    encoder = encoder if isinstance(encoder, ImageEncoder) else None
    return Policy(agent(old.config.agent), old.state, old.config, old.step, encoder, old)


def rollout(env: Any, actor: Any, observation: Any) -> Iterator[Moment]:
    running = np.ones(env.num_envs, np.bool_)
    while running.any():
        action = actor(observation["observation"], observation["desired_goal"])
        observation, _, terminated, truncated, info = env.step(action)
        ended = terminated | truncated
        yield Moment(observation, info, ended & running, running)
        running = running & ~ended
        if ended.any():
            observation, _ = env.reset(options={"reset_mask": ended})
            actor.restart(ended)


def read(path: Path) -> Table:
    if not path.exists():
        return {}
    try:
        with path.open(newline="") as file:
            header, *rows = list(csv.reader(file)) or [[]]
        whole = [row for row in rows if len(row) == len(header)]
        columns = dict(zip(header, zip(*whole, strict=True), strict=False))
        return {
            name: np.array(values)
            if name in TEXT_COLUMNS
            else np.array([value or "nan" for value in values], np.float64)
            for name, values in columns.items()
        }
    except (OSError, ValueError) as error:
        raise ConfigurationError(f"{path} cannot be read: {error}") from error


def write(path: Path, table: Table) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(path.name + ".new")
    columns = [
        [f"{value:.6g}" if isinstance(value, float) else value for value in column.tolist()]
        for column in table.values()
    ]
    with temporary.open("w", newline="") as file:
        csv.writer(file).writerows([list(table), *zip(*columns, strict=True)])
    temporary.replace(path)


def sample_states(env: Any, count: int, random_actions: int, seed: int) -> Subgoal:
    from midway.training import pretrain
    from midway.types import Pretraining

    return pretrain.sample_states(env, Pretraining(("vae",), count, random_actions, 1), seed)


def save_arrays(path: Path, tree: Any) -> None:
    from safetensors.numpy import save_file

    from midway.training.arrays import named_arrays

    temporary = path.with_name(path.name + ".new")
    save_file({name: np.asarray(a) for name, a in named_arrays(tree).items()}, temporary)
    temporary.replace(path)


def load_arrays(path: Path, tree: Any) -> Any:
    from safetensors import SafetensorError
    from safetensors.numpy import load_file

    from midway.training.arrays import with_named_arrays

    try:
        return with_named_arrays(tree, load_file(path))
    except (OSError, SafetensorError) as error:
        raise ConfigurationError(f"{path} cannot be read: {error}") from error
