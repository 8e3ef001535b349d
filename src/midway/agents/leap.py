"""LEAP: planning of latent subgoals over a temporal difference model (Nasiriany et al. 2019).

A LEAP is a `midway.agents.tdm` with an autoencoder of states, trained before it, and a planner that
is used in acting only. The episode's time is divided into equal segments. At the start of each, the
planner chooses the subgoals at the ends of the segments to come so that the worst of the TDM's
values along start, subgoals and goal is best; the TDM's policy then aims at the first of them.
"""

import dataclasses
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int, Key, Shaped

from midway import functional
from midway.agents import tdm
from midway.networks import optimizer
from midway.networks import vae as vaes
from midway.networks.vae import ImageVAE, StateVAE
from midway.planning import cem
from midway.types import Batch, EnvSpec, Metrics, Pretraining, Subgoal


@dataclass(frozen=True)
class Config(tdm.Config):
    """Hyperparameters of LEAP, those of TDM included; the defaults are those of the ant.

    Attributes:
        num_subgoals: Subgoals of a plan at the start of an episode (table 2).
        latent_size: Latent numbers of a subgoal (appendix D).
        vae_hidden: Hidden layers of the encoder of states; the decoder's are the reverse.
        vae_kl_weight: Weight of the KL divergence to the prior of the latent numbers.
        vae_learning_rate: Adam's rate for the autoencoder.
        vae_states: States that it is trained on, of which every tenth is held out.
        vae_random_actions: Random actions after each reset; the states before and after each are
            used.
        vae_rounds: Rounds of its training.
        vae_updates: Updates in each round.
        vae_batch_size: States in the batch of one of its updates.
        vae_source: Run folder whose autoencoder is taken instead, or nothing.
        plan_samples: Candidates in each iteration of the planner.
        plan_iterations: Iterations of the planner.
        plan_elites: Shares of candidates that it is refitted to, each for an equal part of them.
        plan_std: Standard deviation of the latent numbers in its first iteration.
        prior_weight: Weight of the subgoals' log-density among the latent numbers.
    """

    num_subgoals: int = 11
    latent_size: int = 8
    vae_hidden: tuple[int, ...] = (64, 128, 64)
    vae_kl_weight: float = 0.01
    vae_learning_rate: float = 1e-3
    vae_states: int = 50_000
    vae_random_actions: int = 1
    vae_rounds: int = 2_500
    vae_updates: int = 100
    vae_batch_size: int = 128
    vae_source: str = ""
    plan_samples: int = 10_000
    plan_iterations: int = 50
    plan_elites: tuple[float, ...] = (0.25, 0.01)
    plan_std: float = 1.5
    prior_weight: float = 0.1


class State(tdm.State):
    """A TDM's state, the autoencoder and its optimiser."""

    vae: StateVAE | ImageVAE
    vae_optimizer: optax.OptState
    config: Config = eqx.field(static=True)


NETWORKS = (*tdm.NETWORKS, "vae")
"""The parts of the state that a saved policy holds."""

NUM_MEASURED = 1_000
"""Held-out states that are reconstructed at the end of each round."""


class Memory(NamedTuple):
    """What is remembered of an episode.

    Attributes:
        explorer: What the TDM remembers, where there is no planning but exploration.
        elapsed: Steps taken.
        latents: The plan: latent numbers of the subgoals at the ends of all segments but the last.
    """

    explorer: tdm.Memory
    elapsed: Int[Array, " B"]
    latents: Float[Array, "B N L"]


# --- time and subgoals ----------------------------------------------------------------------------


def segment_steps(config: Config, spec: EnvSpec) -> int:
    """Return the steps of a segment: an equal part of the episode, at most the TDM's horizon."""
    equal_part = -(-spec.max_episode_steps // (config.num_subgoals + 1))
    return min(equal_part, config.max_steps_left + 1)


def codes(state: State, observation: Shaped[Array, "*B"]) -> Float[Array, "..."]:
    """Return what the TDM reads: states in its units, or the latent means of images."""
    if state.spec.is_image:
        return state.vae.encode(observation).mean
    return state.encoder(observation.astype(jnp.float32))


def subgoal_codes(state: State, latent: Float[Array, "*B L"]) -> Subgoal:
    """Return the subgoals that latent numbers stand for, as the TDM reads them.

    States are decoded; images are decoded and encoded again, so that the TDM meets no latent
    numbers but those of images (original code).
    """
    decoded = state.vae.decode(latent)
    if state.spec.is_image:
        decoded = state.vae.encode(decoded).mean
    decoded = state.encoder(decoded)
    if state.spec.goal_is_observation:
        return Subgoal(decoded, decoded)
    size = state.spec.observation_shape[0]
    return Subgoal(decoded[..., :size], decoded[..., size:])


def vae_inputs(spec: EnvSpec, states: Subgoal) -> Shaped[Array, "N ..."]:
    """Return what the autoencoder reads of states: both roles where they differ."""
    if spec.goal_is_observation:
        return states.observation
    return jnp.concatenate(states, axis=-1)


# --- plan -----------------------------------------------------------------------------------------


def score(
    state: State,
    latents: Float[Array, "S N L"],
    observation: Float[Array, " O"],
    goal: Float[Array, " G"],
    segment: Int[Array, ""],
) -> Float[Array, " S"]:
    """Return the smallest V of the segments from this one on, plus the subgoals' log-density.

    min_i V(s_i, s_i+1, n) + c Σ_i log N(z_i; 0, 1), where s_i are the state, the decoded subgoals
    and the goal; for S candidate plans at once.
    """
    config, last = state.config, state.config.num_subgoals
    steps_left = jnp.full((len(latents), 1), segment_steps(config, state.spec) - 1.0)
    goals = jnp.broadcast_to(goal, (len(latents), *goal.shape))
    start = jnp.broadcast_to(observation, (len(latents), *observation.shape))

    def follow(
        i: Int[Array, ""], carry: tuple[Float[Array, "S O"], Float[Array, " S"]]
    ) -> tuple[Float[Array, "S O"], Float[Array, " S"]]:
        start, worst = carry
        subgoal = subgoal_codes(state, latents[:, jnp.minimum(i, last - 1)])
        aim = jnp.where(i == last, goals, subgoal.achieved_goal)
        return subgoal.observation, jnp.minimum(worst, tdm.value(state, start, aim, steps_left))

    unbounded = jnp.full(len(latents), jnp.inf)
    _, worst = jax.lax.fori_loop(segment, last + 1, follow, (start, unbounded))
    standard = jnp.zeros_like(latents)
    log_density = functional.gaussian_log_density(latents, standard, standard)
    prior = jnp.where(jnp.arange(last) >= segment, log_density, 0.0).sum(1)
    total: Float[Array, " S"] = worst + config.prior_weight * prior
    return total


def plan(
    state: State,
    observation: Float[Array, " O"],
    goal: Float[Array, " G"],
    segment: Int[Array, ""],
    latents: Float[Array, "N L"],
    key: Key[Array, ""],
) -> Float[Array, "N L"]:
    """Return latent numbers of the subgoals to come, planned from those of the plan before."""
    config = state.config
    elites = cem.elite_schedule(config.plan_samples, config.plan_iterations, config.plan_elites)

    def cost(candidates: Float[Array, "S N L"]) -> Float[Array, " S"]:
        return -score(state, candidates, observation, goal, segment)

    return cem.minimise(cost, latents, config.plan_std, elites, config.plan_samples, key)[0]


def plan_where_due(
    state: State,
    observation: Float[Array, "B O"],
    goal: Float[Array, "B G"],
    memory: Memory,
    key: Key[Array, ""],
) -> Float[Array, "B N L"]:
    """Return the plans, made anew where a segment begins that is not the last: one by one."""
    steps = segment_steps(state.config, state.spec)
    segment = memory.elapsed // steps
    due = (memory.elapsed % steps == 0) & (segment < state.config.num_subgoals)

    def one(row: tuple[Any, ...]) -> Any:
        due, *inputs = row
        return jax.lax.cond(due, lambda *x: plan(state, *x), lambda *x: x[3], *inputs)

    keys = jax.random.split(key, len(due))
    rows = (due, observation, goal, segment, memory.latents, keys)
    plans: Float[Array, "B N L"] = jax.lax.map(one, rows)
    return plans


# --- losses and update ----------------------------------------------------------------------------


def update(state: State, batch: Batch, key: Key[Array, ""]) -> tuple[State, Metrics]:
    """Return the state after one update of the TDM; the autoencoder stays as it is."""
    if state.spec.is_image:
        batch = batch._replace(
            observation=codes(state, batch.observation),
            next_observation=codes(state, batch.next_observation),
            goal=codes(state, batch.goal),
        )
    return tdm.update(state, batch, key)


def pretraining(config: Config) -> Pretraining:
    """Return how much there is to learn before the first update."""
    return Pretraining(
        networks=("vae",),
        states=config.vae_states,
        random_actions=config.vae_random_actions,
        rounds=config.vae_rounds,
        source=config.vae_source,
    )


def pretrain(state: State, states: Subgoal, key: Key[Array, ""]) -> tuple[State, Metrics]:
    """Return the state after one round of the autoencoder's training, and means to log.

    The last tenth of the states is held out; a part of it is measured at the end of the round.
    """
    inputs = vae_inputs(state.spec, states)
    num_training = len(inputs) * 9 // 10

    def one(state: State, key: Key[Array, ""]) -> tuple[State, Metrics]:
        rows_key, noise_key = jax.random.split(key)
        rows = jax.random.randint(rows_key, (state.config.vae_batch_size,), 0, num_training)
        return update_vae(state, inputs[rows], noise_key)

    state = replace(state, vae=state.vae.standardised(inputs[:num_training]))
    state, metrics = jax.lax.scan(one, state, jax.random.split(key, state.config.vae_updates))
    means = {name: values.mean() for name, values in metrics.items()}
    return state, means | vae_errors(state, inputs[num_training:][:NUM_MEASURED])


def vae_errors(state: State, inputs: Shaped[Array, "N ..."]) -> Metrics:
    """Return the mean error of reconstructed states, and for states that of their distance (m)."""
    reconstruction = state.vae.decode(state.vae.encode(inputs).mean)
    errors = {"vae/held_out_error": state.vae.error(inputs, reconstruction).mean()}
    if not state.spec.is_image:
        goals = slice(-state.spec.goal_shape[0], None)
        distance = state.spec.task.distance(reconstruction[:, goals], inputs[:, goals])
        errors["vae/held_out_distance"] = distance.mean()
    return errors


def update_vae(
    state: State, states: Shaped[Array, "B ..."], key: Key[Array, ""]
) -> tuple[State, Metrics]:
    """Return the state after one gradient step of the autoencoder."""
    noise = jax.random.normal(key, (len(states), state.config.latent_size))
    gradient_of = eqx.filter_value_and_grad(vaes.loss, has_aux=True)
    (_, metrics), gradient = gradient_of(state.vae, states, noise, state.config.vae_kl_weight)
    vae, vae_optimizer = optimizer.step(
        state.vae, gradient, state.vae_optimizer, state.config.vae_learning_rate
    )
    return replace(state, vae=vae, vae_optimizer=vae_optimizer), metrics


# --- act and create -------------------------------------------------------------------------------


def begin(config: Config, spec: EnvSpec, num_episodes: int) -> Memory:
    """Return what is remembered before the first step: no time has passed, no plan is made."""
    return Memory(
        tdm.begin(config, spec, num_episodes),
        jnp.zeros(num_episodes, jnp.int32),
        jnp.zeros((num_episodes, config.num_subgoals, config.latent_size)),
    )


def act_on(
    state: State,
    memory: Memory,
    observation: Shaped[Array, "B ..."],
    goal: Shaped[Array, "B ..."],
    key: Key[Array, ""],
    explore: bool,
) -> tuple[Float[Array, "B A"], Memory]:
    """Return actions, and the plans that they follow.

    Where ``explore``, the TDM aims at the goal itself, without a plan, as data are collected.
    """
    start, goal = codes(state, observation), codes(state, goal)
    if explore:
        actions, explorer = tdm.act_on(state, memory.explorer, start, goal, key, True)
        return actions, memory._replace(explorer=explorer)
    memory = memory._replace(latents=plan_where_due(state, start, goal, memory, key))
    steps = segment_steps(state.config, state.spec)
    steps_left = (steps - 1 - memory.elapsed % steps)[:, None].astype(jnp.float32)
    actions = jnp.tanh(state.policy(start, aims(state, memory, goal), steps_left))
    return actions, memory._replace(elapsed=memory.elapsed + 1)


def aims(state: State, memory: Memory, goal: Float[Array, "B G"]) -> Float[Array, "B G"]:
    """Return the current subgoals, or the goals in the last segment."""
    segment = memory.elapsed // segment_steps(state.config, state.spec)
    last = state.config.num_subgoals
    row = jnp.arange(len(segment))
    subgoal = subgoal_codes(state, memory.latents[row, jnp.minimum(segment, last - 1)])
    return jnp.where(segment[:, None] >= last, goal, subgoal.achieved_goal)


def act(
    state: State,
    observation: Shaped[Array, "B ..."],
    goal: Shaped[Array, "B ..."],
    key: Key[Array, ""],
    explore: bool,
) -> Float[Array, "B A"]:
    """Return actions in [-1, 1] of an episode's first step: planned, unless ``explore``."""
    memory = begin(state.config, state.spec, len(observation))
    return act_on(state, memory, observation, goal, key, explore)[0]


def create(config: Config, spec: EnvSpec, key: Key[Array, ""]) -> State:
    """Return networks at their random start.

    Raises:
        ConfigurationError: As `midway.agents.tdm.create`.
    """
    vae_key, tdm_key = jax.random.split(key)
    vae = vaes.create(spec, config.latent_size, config.vae_hidden, vae_key)
    coded = replace(spec, observation_shape=(config.latent_size,), goal_shape=(config.latent_size,))
    model = tdm.create(config, coded if spec.is_image else spec, tdm_key)
    parts = {field.name: getattr(model, field.name) for field in dataclasses.fields(model)}
    return State(**{**parts, "spec": spec}, vae=vae, vae_optimizer=optimizer.init(vae))
