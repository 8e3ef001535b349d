"""The vector environment with goals: everything but the simulation itself."""

from collections.abc import Mapping, Sequence
from typing import ClassVar, TypeAlias

import numpy as np
from gymnasium import spaces
from gymnasium.error import ResetNeeded
from gymnasium.utils.seeding import np_random
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from jaxtyping import Bool, Float, Int, Shaped, UInt64

from midway.errors import ConfigurationError
from midway.types import DistanceTask, EnvSpec, Info, NumPyArray, Options, Step
from midway.types import Observations as Observations

Array: TypeAlias = NumPyArray


class GoalVectorEnv(VectorEnv[Observations, Array, Array]):
    """Copies of one goal environment that are stepped together and reset by a mask.

    Nothing is reset of its own accord (``AutoresetMode.DISABLED``): an ended copy has to be reset
    with ``options={"reset_mask": mask}`` before the next step. Each copy has its own generator,
    so a batch of N equals N batches of one.

    A subclass implements ``_begin``, ``_advance`` and ``_observe``, and extends ``state_dict`` and
    ``load_state_dict`` by what it holds.

    Args:
        goal_spec: What agents may know of the environment.
        num_envs: Number of copies.
        tasks: Names of the tasks (distributions of start and goal).
        task: The first current task.
        observation_box: Bounds of one observation.
        goal_box: Bounds of one goal.
        state_box: Bounds of the state that success is measured on, where goals are images.

    Raises:
        ConfigurationError: ``task`` is not one of ``tasks``, or ``num_envs`` is not positive.
    """

    metadata = {"autoreset_mode": AutoresetMode.DISABLED, "render_modes": []}  # noqa: RUF012
    resumable = True
    """Whether ``load_state_dict`` continues in the middle of the episodes."""
    option_names: tuple[str, ...] = ("reset_mask", "task")
    """What ``options`` of ``reset`` may hold."""
    logged_info: ClassVar[Mapping[str, str]] = {}
    """Info whose mean over the steps of collection is logged, as ``collect/`` and the name here."""
    single_observation_space: spaces.Dict

    def __init__(
        self,
        goal_spec: EnvSpec,
        num_envs: int,
        tasks: tuple[str, ...],
        task: str,
        observation_box: spaces.Box,
        goal_box: spaces.Box,
        state_box: spaces.Box | None = None,
    ) -> None:
        if num_envs < 1:
            raise ConfigurationError(f"num_envs {num_envs}: must be at least 1")
        self.goal_spec = goal_spec
        self.num_envs = num_envs
        self.tasks = tasks
        self.task = self._checked_task(task)
        boxes: dict[str, spaces.Space[Array]] = {"observation": observation_box}
        boxes |= {"achieved_goal": goal_box, "desired_goal": goal_box}
        if state_box is not None:
            boxes |= {"achieved_state": state_box, "desired_state": state_box}
        self.single_observation_space = spaces.Dict(boxes)
        self.single_action_space = spaces.Box(-1, 1, (goal_spec.action_dim,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.generators = [np_random()[0] for _ in range(num_envs)]
        self._elapsed = np.zeros(num_envs, np.int64)
        self._ended = np.ones(num_envs, np.bool_)

    def _begin(self, copies: Int[Array, " n"], options: Options) -> None:
        """Start a new episode of the current task in these copies."""
        raise NotImplementedError

    def _advance(self, actions: Shaped[Array, "num_envs action_dim"]) -> None:
        """Move every copy by one step."""
        raise NotImplementedError

    def _observe(self) -> Observations:
        """Return the observations of every copy in newly allocated arrays."""
        raise NotImplementedError

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: Options | None = None,
    ) -> tuple[Observations, Info]:
        """Start new episodes.

        Args:
            seed: Seed of copy 0, copy i takes ``seed + i``; or one seed per copy; or none, to go
                on with the generators as they are.
            options: ``reset_mask``, bool ``(num_envs,)``: the copies to reset and to seed, by
                default all. ``task``: the task from now on. Others are the environment's own.

        Returns:
            Observations of every copy and info, where ``_distance`` and so on is the mask.

        Raises:
            ConfigurationError: An unknown option or task.
            ValueError: A mask or seeds of the wrong shape, or an empty mask.
            TypeError: A mask that is no array of bool.
        """
        options = dict(options or {})
        for name in options:
            if name not in self.option_names:
                allowed = ", ".join(self.option_names)
                raise ConfigurationError(f"unknown reset option {name!r}: use one of {allowed}")
        mask = self._checked_mask(options.pop("reset_mask", None))
        self.task = self._checked_task(options.pop("task", self.task))
        copies = np.flatnonzero(mask)
        seeds = self._seed_of_each_copy(seed)
        for copy in copies:
            if seeds[copy] is not None:
                self.generators[copy] = np_random(seeds[copy])[0]
        self._ended[mask] = True  # should beginning fail, no copy goes on half begun
        self._begin(copies, options)
        self._elapsed[mask] = 0
        self._ended[mask] = False
        observations = self._observe()
        achieved, desired = self.success_pair(observations)
        _, reached = self.goal_spec.task(achieved, desired)
        return observations, self._info(achieved, desired, reached, mask)

    def step(self, actions: Array) -> Step:
        """Move every copy by one step.

        Args:
            actions: ``(num_envs, action_dim)``; values beyond [-1, 1] act as the nearest bound.

        Returns:
            Observations, reward float32, terminated (the goal is reached) and truncated (the
            episode is at its limit), both of which can be true at once, and info: ``distance``
            to the goal, ``is_success``, ``elapsed_steps``; ``distance_hand`` and so on where
            the task names several distances; others are the environment's own.

        Raises:
            ResetNeeded: An episode has ended or never begun (Gymnasium's own vector environments
                fail here too without autoreset).
            ValueError: Actions of another shape, or not finite.
        """
        if self._ended.any():
            ended = np.flatnonzero(self._ended).tolist()
            raise ResetNeeded(f"copies {ended} have no running episode: reset them by a mask")
        actions = np.asarray(actions)
        if actions.shape != self.action_space.shape or not np.isfinite(actions).all():
            raise ValueError(
                f"actions of shape {actions.shape}: must be finite, {self.action_space.shape}"
            )
        self._advance(actions)
        self._elapsed += 1
        observations = self._observe()
        achieved, desired = self.success_pair(observations)
        reward, terminated = self.goal_spec.task(achieved, desired)
        truncated = self._elapsed >= self.goal_spec.max_episode_steps
        self._ended = terminated | truncated
        everyone = np.ones(self.num_envs, np.bool_)
        info = self._info(achieved, desired, terminated, everyone)
        return observations, reward, terminated, truncated, info

    def rest(self, mask: Bool[Array, " num_envs"]) -> Observations:
        """Ask no more of these copies, whose episodes are over, until they are reset.

        Returns:
            The observations of every copy. All are stepped together, so these begin anew.
        """
        return self.reset(options={"reset_mask": mask})[0]

    def ways(self) -> Float[Array, " num_envs"]:
        """Return how far each copy is from its goal, as a share of the way of the task ``hard``.

        At most 1, which it is everywhere in an environment whose ways are not known.
        """
        return np.ones(self.num_envs)

    def success_pair(self, observations: Mapping[str, Array]) -> tuple[Array, Array]:
        """Return what success is measured on: the states where there are any, else the goals."""
        kind = "goal" if self.goal_spec.state_shape is None else "state"
        return observations[f"achieved_{kind}"], observations[f"desired_{kind}"]

    @property
    def np_random(self) -> tuple[np.random.Generator, ...]:  # type: ignore[override]
        """The generator of each copy, as Gymnasium's own vector environments give them."""
        return tuple(self.generators)

    def state_dict(self) -> dict[str, Array]:
        """Return all that the future depends on, as arrays of numbers."""
        return {
            "elapsed": self._elapsed.copy(),
            "ended": self._ended.copy(),
            "task": np.array(self.tasks.index(self.task)),
            "generators": np.stack([_generator_row(rng) for rng in self.generators]),
        }

    def load_state_dict(self, state: Mapping[str, Array]) -> None:
        """Continue from a ``state_dict``, bit for bit.

        Raises:
            ConfigurationError: The state belongs to another environment or number of copies.
        """
        for key, mine in self.state_dict().items():
            shape = np.shape(state[key]) if key in state else None
            if shape != mine.shape:
                raise ConfigurationError(
                    f"environment state {key!r} of shape {shape}: must be {mine.shape}"
                )
        self._elapsed[:] = state["elapsed"]
        self._ended[:] = state["ended"]
        self.task = self.tasks[int(state["task"])]
        self.generators = [_generator_of(row) for row in np.asarray(state["generators"])]

    def _info(
        self, achieved: Array, desired: Array, reached: Array, mask: Bool[Array, " num_envs"]
    ) -> Info:
        """Return info in Gymnasium's form: a value per copy and, as ``_name``, who has it."""
        info = {
            "distance": self.goal_spec.task.distance(achieved, desired).astype(np.float64),
            "is_success": reached.copy(),
            "elapsed_steps": self._elapsed.copy(),
            **self._own_info(),
        }
        if isinstance(self.goal_spec.task, DistanceTask):
            distances = self.goal_spec.task.named_distances(achieved, desired)
            info |= {f"distance_{name}": d.astype(np.float64) for name, d in distances.items()}
        return info | {f"_{name}": mask.copy() for name in info}

    def _own_info(self) -> dict[str, Array]:
        """Return further info, ``(num_envs,)`` each, in newly allocated arrays."""
        return {}

    def _checked_task(self, task: str) -> str:
        if task not in self.tasks:
            allowed = ", ".join(self.tasks)
            raise ConfigurationError(
                f"unknown task {task!r} of {self.goal_spec.name}: use one of {allowed}"
            )
        return task

    def _checked_mask(self, mask: object) -> Bool[Array, " num_envs"]:
        """Return the mask, or everyone for None; the checks are those of Gymnasium."""
        if mask is None:
            return np.ones(self.num_envs, np.bool_)
        if not isinstance(mask, np.ndarray) or mask.dtype != np.bool_:
            raise TypeError(f"options['reset_mask'] must be a NumPy array of bool, got {mask!r}")
        if mask.shape != (self.num_envs,):
            raise ValueError(
                f"options['reset_mask'] must have shape ({self.num_envs},), got {mask.shape}"
            )
        if not mask.any():
            raise ValueError("options['reset_mask'] must hold at least one True")
        return mask

    def _seed_of_each_copy(self, seed: int | Sequence[int | None] | None) -> list[int | None]:
        if seed is None:
            return [None] * self.num_envs
        if isinstance(seed, int | np.integer):
            return [int(seed) + copy for copy in range(self.num_envs)]
        if len(seed) != self.num_envs:
            raise ValueError(f"{len(seed)} seeds for {self.num_envs} copies")
        return list(seed)


def _generator_row(rng: np.random.Generator) -> UInt64[Array, "6"]:
    """Return the state of a PCG64 generator as six words."""
    state = rng.bit_generator.state
    words = [state["state"][key] >> shift for key in ("state", "inc") for shift in (64, 0)]
    words += [state["has_uint32"], state["uinteger"]]
    return np.array([word & (2**64 - 1) for word in words], np.uint64)


def _generator_of(row: UInt64[Array, "6"]) -> np.random.Generator:
    """Return the generator that ``_generator_row`` was taken from."""
    words = [int(word) for word in row]
    bits = np.random.PCG64()
    bits.state = {
        "bit_generator": "PCG64",
        "state": {"state": words[0] << 64 | words[1], "inc": words[2] << 64 | words[3]},
        "has_uint32": words[4],
        "uinteger": words[5],
    }
    return np.random.Generator(bits)
