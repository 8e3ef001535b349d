"""LEAP: planning of latent subgoals over a temporal difference model (Nasiriany et al. 2019).

A LEAP is a `midway.agents.tdm` with an autoencoder of states, trained before it, and a planner that
is used in acting only. The episode's time is divided into equal segments. At the start of each, the
planner chooses the subgoals at the ends of the segments to come so that the worst of the TDM's
values along start, subgoals and goal is best; the TDM's policy then aims at the first of them. An
episode with a shorter way begins in a later segment, and so has fewer subgoals.
"""

import dataclasses
from dataclasses import dataclass, replace
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float, Int, Key, Shaped

from midway import functional
from midway.agent import Agent, EpisodeMemory, Freezing, Plan, Pretrain, PretrainSettings
from midway.agents import tdm
from midway.networks import encoder as encoders
from midway.networks import optimizer
from midway.networks import vae as vaes
from midway.networks.vae import ImageVAE, LatentMean, StateVAE
from midway.planning import cem
from midway.settings import setting
from midway.types import AnyArray, EnvSpec, Metrics, Subgoal


@dataclass(frozen=True)
class Config(tdm.Config):
    """Hyperparameters of LEAP, those of TDM included; the defaults are those of the ant."""

    num_subgoals: int = setting(11, "table 2", "of a plan for the longest way", least=1)
    adapt_subgoals: bool = setting(True, "appendix D", "plans for shorter ways have their share")
    latent_size: int = setting(8, "appendix D", "latent numbers of a subgoal", least=1)
    vae_hidden: tuple[int, ...] = setting((64, 128, 64), "appendix D", "of the encoder", least=1)
    vae_kl_weight: float = setting(
        1e-4, "leap.md", "β", least=0, deviates="1e-2 of the code loses the position"
    )
    vae_learning_rate: float = setting(1e-3, "code of LEAP", "Adam, VAE", above=0, most=1)
    vae_states: int = setting(50_000, "code of LEAP", "data; a tenth is held out", least=10)
    vae_random_actions: int = setting(
        0, "leap.md", "after each reset", least=0, deviates="1 of the code loses the position"
    )
    vae_rounds: int = setting(2_500, "code of LEAP", "epochs", least=1)
    vae_updates: int = setting(100, "code of LEAP", "of each round", least=1)
    vae_batch_size: int = setting(128, "code of LEAP", "states of one update", least=1)
    vae_source: str = setting("", "none", "run folder whose VAE is taken instead")
    plan_samples: int = setting(10_000, "code of LEAP", "of an iteration of CEM", least=1)
    plan_iterations: int = setting(50, "code of LEAP", "of CEM", least=1)
    plan_elites: tuple[float, ...] = setting((0.25, 0.01), "code of LEAP", above=0, most=1)
    plan_std: float = setting(1.5, "code of LEAP", "of latents at first", above=0)
    prior_weight: float = setting(0.1, "code of LEAP", "c, of the latents' density", least=0)


class State(tdm.State):
    """A TDM's state, the autoencoder and its optimiser."""

    vae: StateVAE | ImageVAE
    vae_optimizer: optax.OptState
    config: Config = eqx.field(static=True)


NUM_MEASURED = 1_000
"""Held-out states that are reconstructed at the end of each round."""

SEARCH = ("plan_samples", "plan_iterations", "plan_elites", "plan_std")


class Memory(NamedTuple):
    """What is remembered of an episode.

    Attributes:
        explorer: What the TDM remembers, where there is no planning but exploration.
        elapsed: Steps taken.
        latents: The plan: latent numbers of the subgoals at the ends of all segments but the last.
        first: The segment that the episode begins in; subgoals before it are left out.
    """

    explorer: tdm.Memory
    elapsed: Int[Array, " B"]
    latents: Float[Array, "B N L"]
    first: Int[Array, " B"]


# --- time and subgoals ----------------------------------------------------------------------------


def segment_steps(config: Config, spec: EnvSpec) -> int:
    """Return the steps of a segment: an equal part of the episode, at most the TDM's horizon."""
    equal_part = -(-spec.max_episode_steps // (config.num_subgoals + 1))
    return min(equal_part, config.max_steps_left + 1)


def segment_of(state: State, memory: Memory) -> Int[Array, " B"]:
    """Return the segments that the episodes are in; the last one aims at the goal."""
    return memory.first + memory.elapsed // segment_steps(state.config, state.spec)


def subgoals_of(state: State, latent: Float[Array, "*B L"]) -> Subgoal:
    """Return the subgoals that latent numbers stand for, as the TDM reads them.

    States are decoded; images are decoded and encoded again, so that the TDM meets no latent
    numbers but those of images (original code).
    """
    decoded = state.vae.decode(latent)
    if state.spec.image_shape:
        decoded = state.vae.encode(decoded).mean
    decoded = state.encoder(decoded)
    return encoders.as_subgoal(state.spec, decoded)


def planned(state: State, memory: Memory) -> Plan:
    """Return the plans that the last actions followed; what is left out of one is its first."""
    numbers = jnp.maximum(jnp.arange(state.config.num_subgoals), memory.first[:, None])
    latents = jnp.take_along_axis(memory.latents, numbers[..., None], axis=1)
    subgoals = state.encoder.states(subgoals_of(state, latents).achieved_goal)
    segment = segment_of(state, memory._replace(elapsed=memory.elapsed - 1))
    return Plan(subgoals, due=jnp.clip(segment, 0, state.config.num_subgoals - 1))


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
        subgoal = subgoals_of(state, latents[:, jnp.minimum(i, last - 1)])
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
    segment = segment_of(state, memory)
    due = (memory.elapsed % steps == 0) & (segment < state.config.num_subgoals)

    def one(row: tuple[Array, ...]) -> Float[Array, "N L"]:
        due, *inputs = row
        planned: Float[Array, "N L"] = jax.lax.cond(
            due, lambda *x: plan(state, *x), lambda *x: x[3], *inputs
        )
        return planned

    keys = jax.random.split(key, len(due))
    rows = (due, observation, goal, segment, memory.latents, keys)
    plans: Float[Array, "B N L"] = jax.lax.map(one, rows)
    return plans


# --- the autoencoder ----------------------------------------------------------------------------


def pretrain_settings(config: Config) -> PretrainSettings:
    """Return how much there is to learn before the first update."""
    return PretrainSettings(
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
    inputs = encoders.as_vector(state.spec, states)
    num_training = len(inputs) * 9 // 10

    def one(state: State, key: Key[Array, ""]) -> tuple[State, Metrics]:
        rows_key, noise_key = jax.random.split(key)
        rows = jax.random.randint(rows_key, (state.config.vae_batch_size,), 0, num_training)
        return update_vae(state, inputs[rows], noise_key)

    state = replace(state, vae=state.vae.standardised(inputs[:num_training]))
    state, metrics = jax.lax.scan(one, state, jax.random.split(key, state.config.vae_updates))
    means = {name: values.mean() for name, values in metrics.items()}
    return state, means | vaes.errors(state.vae, state.spec, inputs[num_training:][:NUM_MEASURED])


def reconstruct(state: State, states: Subgoal) -> Shaped[Array, "N ..."]:
    """Return what is left of states after encoding and decoding."""
    return state.vae.decode(state.vae.encode(encoders.as_vector(state.spec, states)).mean)


def update_vae(
    state: State, states: Shaped[Array, "B ..."], key: Key[Array, ""]
) -> tuple[State, Metrics]:
    """Return the state after one gradient step of the autoencoder."""
    config = state.config
    noise = jax.random.normal(key, (len(states), config.latent_size))
    inputs = (config.vae_learning_rate, states, noise, config.vae_kl_weight)
    old = (vaes.loss, state.vae, state.vae_optimizer)
    vae, vae_optimizer, metrics = optimizer.minimise(*old, *inputs)
    return replace(state, vae=vae, vae_optimizer=vae_optimizer), metrics


# --- act and create -------------------------------------------------------------------------------


def begin(config: Config, spec: EnvSpec, num_episodes: int) -> Memory:
    """Return what is remembered before the first step: no time has passed, no plan is made."""
    return Memory(
        tdm.begin(config, spec, num_episodes),
        jnp.zeros(num_episodes, jnp.int32),
        jnp.zeros((num_episodes, config.num_subgoals, config.latent_size)),
        jnp.zeros(num_episodes, jnp.int32),
    )


def adapt(config: Config, memory: Memory, ways: Float[AnyArray, " B"]) -> Memory:
    """Return the memory of new episodes that plan ⌈way · num_subgoals⌉ subgoals, at least one.

    Appendix D has the number "adapted according to the difficulty", not how: the rule is ours.
    """
    if not config.adapt_subgoals:
        return memory
    number = jnp.clip(jnp.ceil(config.num_subgoals * ways), 1, config.num_subgoals)
    return memory._replace(first=config.num_subgoals - number.astype(jnp.int32))


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
    if explore:
        actions, explorer = tdm.act_on(state, memory.explorer, observation, goal, key, True)
        return actions, memory._replace(explorer=explorer)
    start, goal = state.encoder(observation), state.encoder(goal)
    memory = memory._replace(latents=plan_where_due(state, start, goal, memory, key))
    steps = segment_steps(state.config, state.spec)
    steps_left = (steps - 1 - memory.elapsed % steps)[:, None].astype(jnp.float32)
    actions = jnp.tanh(state.policy(start, aims(state, memory, goal), steps_left))
    return actions, memory._replace(elapsed=memory.elapsed + 1)


def rest(memory: Memory, done: Bool[AnyArray, " B"]) -> Memory:
    """Return the memory with these episodes far beyond their last segment, where none plans."""
    beyond = 2**30
    return memory._replace(elapsed=jnp.where(done, beyond, memory.elapsed))


def aims(state: State, memory: Memory, goal: Float[Array, "B G"]) -> Float[Array, "B G"]:
    """Return the current subgoals, or the goals in the last segment."""
    segment, last = segment_of(state, memory), state.config.num_subgoals
    row = jnp.arange(len(segment))
    subgoal = subgoals_of(state, memory.latents[row, jnp.minimum(segment, last - 1)])
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
    model = tdm.create(config, spec.encoded(config.latent_size) if spec.is_image else spec, tdm_key)
    parts = {field.name: getattr(model, field.name) for field in dataclasses.fields(model)}
    return State(**{**parts, "spec": spec}, vae=vae, vae_optimizer=optimizer.init(vae))


AGENT = Agent(
    Config,
    create,
    tdm.update,
    act,
    networks=(*tdm.NETWORKS, "vae"),
    value=tdm.AGENT.value,
    memory=EpisodeMemory(begin, act_on, rest, planned, adapt),
    pretrain=Pretrain(pretrain_settings, pretrain, reconstruct),
    freezing=Freezing(lambda state: LatentMean(state.vae), at_start=True, kept=("vae",)),
    test_settings=("num_subgoals", "adapt_subgoals", "prior_weight", *SEARCH),
)
