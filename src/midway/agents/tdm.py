"""TDM: temporal difference models, goal-conditioned Q functions of a finite horizon, on TD3.

Pong et al. (2018), as LEAP trains them (Nasiriany et al. 2019; appendix D and table 2). Q(s, a, g,
n) predicts how far from the goal each number of the state will be when n steps are left after this
one: a vector, minus the absolute differences. One update does, in this order: critics, and every
second time policy and target networks. Each step uses the networks that the one before has updated.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int, Key, Shaped

from midway import functional
from midway.agent import Agent, EpisodeMemory, Freezing, Value
from midway.errors import ConfigurationError
from midway.networks import encoder as encoders
from midway.networks import optimizer
from midway.networks.encoder import Encoder
from midway.networks.initialization import with_small_output
from midway.networks.mlp import MLP, PRECISIONS, Precision
from midway.settings import check, setting
from midway.types import Batch, EnvSpec, Metrics

OUTPUT_BOUND = 3e-3
"""Output weights start uniform in ± this (original code)."""


@dataclass(frozen=True)
class Config:
    """Hyperparameters of TDM; the defaults are those of the ant (appendix D, code of LEAP)."""

    hidden: tuple[int, ...] = setting((400, 300), "appendix D", "layers of every network", least=1)
    max_steps_left: int = setting(50, "table 2", "the horizon", least=0)
    num_rewards: int = setting(0, "not in the paper", "length of the reward; 0: all", least=0)
    reward_scale: float = setting(10.0, "code of LEAP", "factor of the reward", above=0)
    target_update_rate: float = setting(0.005, "code of LEAP", "τ", above=0, most=1)
    policy_delay: int = setting(2, "code of LEAP", "critic updates for each of policy", least=1)
    critic_learning_rate: float = setting(1e-3, "code of LEAP", "Adam, critics", above=0, most=1)
    policy_learning_rate: float = setting(1e-3, "code of LEAP", "Adam, policy", above=0, most=1)
    encoder_learning_rate: float = setting(1e-4, "code of RIS", "Adam, images", above=0, most=1)
    random_shift: int = setting(8, "appendix B", "of images, at most (pixels)", least=0)
    normalise: bool = setting(False, "none", "states by the environment's center and spread")
    image_pooling: int = setting(1, "not in the paper", "side of averaged squares", least=1)
    target_noise: float = setting(0.2, "code of LEAP", "deviation, on target actions", least=0)
    target_noise_bound: float = setting(0.5, "code of LEAP", "bound of that noise", least=0)
    saturation_weight: float = setting(1.0, "code of LEAP", "of actions in tanh's tails", least=0)
    saturation_bound: float = setting(20.0, "code of LEAP", "pre-tanh, free of cost", least=0)
    exploration_noise: float = setting(0.3, "code of LEAP", "σ, Ornstein-Uhlenbeck", least=0)
    exploration_reversion: float = setting(0.15, "code of LEAP", "θ of that", least=0, most=1)
    precision: Precision = setting("f32", "code of LEAP", "of products", choices=PRECISIONS)

    def __post_init__(self) -> None:
        """Check the values, or raise a ConfigurationError."""
        check(self)


class State(eqx.Module):
    """Networks, their target networks, their optimisers and the number of updates."""

    encoder: Encoder
    critic: tuple[MLP, MLP]
    target_critic: tuple[MLP, MLP]
    policy: MLP
    target_policy: MLP
    encoder_optimizer: optax.OptState
    critic_optimizer: optax.OptState
    policy_optimizer: optax.OptState
    updates: Int[Array, ""]
    config: Config = eqx.field(static=True)
    spec: EnvSpec = eqx.field(static=True)


AnyState = TypeVar("AnyState", bound=State)


class Memory(NamedTuple):
    """What is remembered of an episode.

    Attributes:
        steps_left: Steps left after the next one.
        noise: State of the exploration noise.
    """

    steps_left: Int[Array, " B"]
    noise: Float[Array, "B A"]


# --- losses ---------------------------------------------------------------------------------------


def reward_vector(config: Config, batch: Batch) -> Float[Array, "B R"]:
    """Return minus the scaled absolute differences of what was achieved to what is desired."""
    achieved, desired = batch.outcome or (batch.next_observation, batch.goal)
    difference = jnp.abs(achieved - desired)[:, : config.num_rewards or None]
    return -config.reward_scale * difference


def q_values(critic: tuple[MLP, MLP], *inputs: Float[Array, "B _"]) -> Float[Array, "2 B R"]:
    """Return the Q vectors of both critics at (s, a, g, n)."""
    return jnp.stack([network(*inputs) for network in critic])


def critic_target(
    state: State,
    batch: Batch,
    reward: Float[Array, "B R"],
    steps_left: Float[Array, "B 1"],
    noise: Float[Array, "B A"],
) -> Float[Array, "B R"]:
    """Return r where no step is left, else min Q'(s', π'(s', g, n - 1) + noise, g, n - 1).

    The minimum is taken for each number of the vector; there is no discount. The sum of action and
    clipped noise is not clipped again (original code).
    """
    bound = state.config.target_noise_bound
    pre_tanh = state.target_policy(batch.next_observation, batch.goal, steps_left - 1)
    action = jnp.tanh(pre_tanh) + jnp.clip(state.config.target_noise * noise, -bound, bound)
    inputs = (batch.next_observation, action, batch.goal, steps_left - 1)
    return jnp.where(steps_left == 0, reward, q_values(state.target_critic, *inputs).min(0))


def critic_loss(
    networks: tuple[tuple[MLP, MLP], Encoder],
    observation: Shaped[Array, "B ..."],
    batch: Batch,
    steps_left: Float[Array, "B 1"],
    target: Float[Array, "B R"],
) -> tuple[Float[Array, ""], tuple[Float[Array, "B S"], Metrics]]:
    """Return both critics' mean squared errors, and the features of the current observations."""
    critic, encoder = networks
    features = encoder(observation)
    q = q_values(critic, features, batch.action, batch.goal, steps_left)
    loss = ((q - target) ** 2).mean((1, 2)).sum()
    metrics = {"critic/loss": loss, "critic/q": q.mean(), "critic/target": target.mean()}
    return loss, (features, metrics)


def policy_loss(
    policy: MLP, state: State, batch: Batch, steps_left: Float[Array, "B 1"]
) -> tuple[Float[Array, ""], Metrics]:
    """Return minus the mean of critic 1's vector, plus the cost of saturated actions."""
    pre_tanh = policy(batch.observation, batch.goal, steps_left)
    q = state.critic[0](batch.observation, jnp.tanh(pre_tanh), batch.goal, steps_left)
    saturation = jax.nn.relu(jnp.abs(pre_tanh) - state.config.saturation_bound).mean()
    loss = -q.mean() + state.config.saturation_weight * saturation
    return loss, {"policy/loss": loss, "policy/saturation": saturation}


def value(
    state: State,
    observation: Float[Array, "B S"],
    goal: Float[Array, "B G"],
    steps_left: Float[Array, "B 1"] | None = None,
) -> Float[Array, " B"]:
    """Return V(s, g, n): minus the L2 distance that critic 1 predicts for the policy's action.

    Where ``steps_left`` is not given, it is the whole horizon.
    """
    if steps_left is None:
        steps_left = jnp.full((len(observation), 1), float(state.config.max_steps_left))
    action = jnp.tanh(state.policy(observation, goal, steps_left))
    q = state.critic[0](observation, action, goal, steps_left)
    distance: Float[Array, " B"] = jnp.linalg.norm(q / state.config.reward_scale, axis=-1)
    return -distance


# --- update ---------------------------------------------------------------------------------------


def update(state: AnyState, batch: Batch, key: Key[Array, ""]) -> tuple[AnyState, Metrics]:
    """Return the state after one gradient step, and scalars to log.

    Scalars of the policy are multiplied by ``policy_delay`` where it was updated and 0 elsewhere,
    so that means over many updates are means over those of the policy.
    """
    encoding_key, steps_key, noise_key = jax.random.split(key, 3)
    reward = reward_vector(state.config, batch)
    observation, batch = encoders.encode_batch(state.encoder, batch, encoding_key)
    steps_left = draw_steps_left(state.config, len(batch.action), steps_key)
    noise = jax.random.normal(noise_key, batch.action.shape)
    target = critic_target(state, batch, reward, steps_left, noise)
    state, features, metrics = update_critic(state, observation, batch, steps_left, target)
    nothing = {"policy/loss": jnp.zeros(()), "policy/saturation": jnp.zeros(())}
    state, policy_metrics = jax.lax.cond(
        state.updates % state.config.policy_delay == 0,
        update_policy_and_targets,
        lambda state, *_: (state, nothing),
        *(state, batch._replace(observation=features), steps_left),
    )
    return replace(state, updates=state.updates + 1), metrics | policy_metrics


def draw_steps_left(config: Config, count: int, key: Key[Array, ""]) -> Float[Array, "B 1"]:
    """Return numbers of steps left, uniform from 0 to the horizon, both included."""
    return jax.random.randint(key, (count, 1), 0, config.max_steps_left + 1).astype(jnp.float32)


def update_critic(
    state: AnyState,
    observation: Shaped[Array, "B ..."],
    batch: Batch,
    steps_left: Float[Array, "B 1"],
    target: Float[Array, "B R"],
) -> tuple[AnyState, Float[Array, "B S"], Metrics]:
    """Step the critics and the encoder; also return the features of the current observations."""
    state, (features, metrics) = optimizer.step_critic_and_encoder(
        critic_loss, state, observation, batch, steps_left, target
    )
    return state, jax.lax.stop_gradient(features), metrics


def update_policy_and_targets(
    state: AnyState, batch: Batch, steps_left: Float[Array, "B 1"]
) -> tuple[AnyState, Metrics]:
    """Step the policy against critic 1 and move all target networks by τ."""
    old, rate = (state.policy, state.policy_optimizer), state.config.policy_learning_rate
    policy, policy_optimizer, metrics = optimizer.minimise(
        policy_loss, *old, rate, state, batch, steps_left
    )
    rate = state.config.target_update_rate
    state = replace(
        state,
        policy=policy,
        policy_optimizer=policy_optimizer,
        target_policy=functional.target_update(policy, state.target_policy, rate),
        target_critic=functional.target_update(state.critic, state.target_critic, rate),
    )
    return state, {name: state.config.policy_delay * value for name, value in metrics.items()}


# --- act and create -------------------------------------------------------------------------------


def begin(config: Config, spec: EnvSpec, num_episodes: int) -> Memory:
    """Return what is remembered before the first step: the whole horizon is left, no noise yet."""
    steps_left = jnp.full(num_episodes, config.max_steps_left)
    return Memory(steps_left, jnp.zeros((num_episodes, spec.action_dim)))


def act_on(
    state: State,
    memory: Memory,
    observation: Shaped[Array, "B ..."],
    goal: Shaped[Array, "B ..."],
    key: Key[Array, ""],
    explore: bool,
) -> tuple[Float[Array, "B A"], Memory]:
    """Return actions, and steps_left counted down from the horizon to 0, again and again.

    Where ``explore``, Ornstein-Uhlenbeck noise is added.
    """
    steps_left = memory.steps_left[:, None].astype(jnp.float32)
    action = jnp.tanh(state.policy(state.encoder(observation), state.encoder(goal), steps_left))
    noise = memory.noise
    if explore:
        kept = (1 - state.config.exploration_reversion) * noise
        noise = kept + state.config.exploration_noise * jax.random.normal(key, noise.shape)
        action = jnp.clip(action + noise, -1, 1)
    again = state.config.max_steps_left
    return action, Memory(jnp.where(memory.steps_left == 0, again, memory.steps_left - 1), noise)


def act(
    state: State,
    observation: Shaped[Array, "B ..."],
    goal: Shaped[Array, "B ..."],
    key: Key[Array, ""],
    explore: bool,
) -> Float[Array, "B A"]:
    """Return actions in [-1, 1] with the whole horizon left; with noise where ``explore``."""
    memory = begin(state.config, state.spec, len(observation))
    return act_on(state, memory, observation, goal, key, explore)[0]


def create(config: Config, spec: EnvSpec, key: Key[Array, ""]) -> State:
    """Return networks at their random start; the target networks equal the online ones.

    Raises:
        ConfigurationError: The goals are images and there is no true state to take rewards from.
    """
    if (spec.is_image or spec.image_shape) and spec.state_shape is None:
        raise ConfigurationError(f"{spec.name}: rewards of tdm need goals or states of numbers")
    encoder_key, first_key, second_key, policy_key = jax.random.split(key, 4)
    num_rewards = config.num_rewards or (spec.state_shape or spec.goal_shape)[0]
    inputs = sum(encoders.feature_sizes(spec)) + 1

    def network(in_size: int, out_size: int, key: Key[Array, ""]) -> MLP:
        new = MLP(in_size, config.hidden, out_size, config.precision, key=key)
        return with_small_output(new, OUTPUT_BOUND)

    encoder = encoders.create(spec, config, encoder_key)
    critic_inputs = inputs + spec.action_dim
    first, second = (network(critic_inputs, num_rewards, k) for k in (first_key, second_key))
    critic = (first, second)
    policy = network(inputs, spec.action_dim, policy_key)
    return State(
        encoder=encoder,
        critic=critic,
        target_critic=functional.copy(critic),
        policy=policy,
        target_policy=functional.copy(policy),
        encoder_optimizer=optimizer.init(encoder),
        critic_optimizer=optimizer.init(critic),
        policy_optimizer=optimizer.init(policy),
        updates=jnp.zeros((), jnp.int32),
        config=config,
        spec=spec,
    )


NETWORKS = ("encoder", "critic", "policy")

AGENT = Agent(
    Config,
    create,
    update,
    act,
    networks=NETWORKS,
    value=Value(encoders.on_observations(value), "value: minus distance left at the horizon"),
    memory=EpisodeMemory(begin, act_on),
    freezing=Freezing(lambda state: state.encoder),
)
