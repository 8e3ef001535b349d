"""SAC: soft actor-critic with a learned entropy coefficient, on the same hindsight replay as RIS.

Haarnoja et al., "Soft actor-critic algorithms and applications" (2018), with goals as inputs; the
target entropy is -dim(A) (appendix D). One update does, in this order: critics, policy, entropy
coefficient, target networks. Each step uses the networks that the step before has just updated.
"""

from dataclasses import dataclass, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Key, Shaped

from midway import functional
from midway.agent import Agent, Freezing, Value
from midway.agents import beyond, entropy
from midway.networks import encoder as encoders
from midway.networks import optimizer
from midway.networks.critics import TwinCritic
from midway.networks.encoder import Encoder
from midway.networks.mlp import PRECISIONS, Precision
from midway.networks.policies import GaussianPolicy
from midway.settings import check, setting
from midway.types import Batch, EnvSpec, Metrics


@dataclass(frozen=True)
class Config(beyond.Settings):
    """Hyperparameters of SAC; the defaults are table 1, ant navigation."""

    hidden: tuple[int, ...] = setting((256, 256), "table 1", "layers of every network", least=1)
    discount: float = setting(0.99, "table 1", "γ", above=0, below=1)
    target_update_rate: float = setting(0.005, "table 1", "τ", above=0, most=1)
    critic_learning_rate: float = setting(1e-3, "table 1", "Adam, critics", above=0, most=1)
    policy_learning_rate: float = setting(1e-3, "table 1", "Adam, policy", above=0, most=1)
    entropy_learning_rate: float = setting(1e-3, "the policy's", "Adam, log c", above=0, most=1)
    encoder_learning_rate: float = setting(1e-4, "code of RIS", "Adam, images", above=0, most=1)
    random_shift: int = setting(8, "appendix B", "of images, at most (pixels)", least=0)
    image_pooling: int = setting(1, "not in the paper", "side of averaged squares", least=1)
    precision: Precision = setting("f32", "code of RIS", "of products", choices=PRECISIONS)

    def __post_init__(self) -> None:
        """Check the values, or raise a ConfigurationError."""
        check(self)


class State(eqx.Module):
    """Networks, the logarithm of the entropy coefficient, and their optimisers."""

    encoder: Encoder
    critic: TwinCritic
    target_critic: TwinCritic
    policy: GaussianPolicy
    log_entropy_coefficient: Float[Array, ""]
    encoder_optimizer: optax.OptState
    critic_optimizer: optax.OptState
    policy_optimizer: optax.OptState
    entropy_optimizer: optax.OptState
    config: Config = eqx.field(static=True)
    spec: EnvSpec = eqx.field(static=True)


# --- losses ---------------------------------------------------------------------------------------


def critic_target(state: State, batch: Batch, noise: Float[Array, "B A"]) -> Float[Array, " B"]:
    """Return r + γ (1 - terminated) (min Q'(s', a', g) - c log π(a' | s', g)), a' ~ π_θ."""
    next_action, log_density = state.policy(batch.next_observation, batch.goal).squashed(noise)
    next_q = state.target_critic(batch.next_observation, next_action, batch.goal).min(0)
    next_value = next_q - jnp.exp(state.log_entropy_coefficient) * log_density
    return beyond.n_step_target(batch, next_value, state.config)


def critic_loss(
    networks: tuple[TwinCritic, Encoder],
    observation: Shaped[Array, "B ..."],
    batch: Batch,
    target: Float[Array, " B"],
) -> tuple[Float[Array, ""], tuple[Float[Array, "B S"], Metrics]]:
    """Return the loss of the critics, and the features of the current observations."""
    critic, encoder = networks
    features = encoder(observation)
    q = critic(features, batch.action, batch.goal)
    loss = functional.critic_loss(q, target)
    metrics = {"critic/loss": loss, "critic/q": q.mean(), "critic/target": target.mean()}
    return loss, (features, metrics)


def policy_loss(
    policy: GaussianPolicy, state: State, batch: Batch, noise: Float[Array, "B A"]
) -> tuple[Float[Array, ""], tuple[Float[Array, ""], Metrics]]:
    """Return the mean of c log π_θ(a | s, g) - min Q, and the entropy estimate."""
    action, log_density = policy(batch.observation, batch.goal).squashed(noise)
    q = state.critic(batch.observation, action, batch.goal).min(0)
    loss = (jnp.exp(state.log_entropy_coefficient) * log_density - q).mean()
    estimate = -log_density.mean()
    return loss, (estimate, {"policy/loss": loss, "policy/entropy": estimate})


def value(
    state: State, observation: Float[Array, "B S"], goal: Float[Array, "B G"]
) -> Float[Array, " B"]:
    """Return V(s, g): the smaller Q at the tanh of the policy's mean action, without entropy."""
    action = jnp.tanh(state.policy(observation, goal).mean)
    return state.critic(observation, action, goal).min(0)


# --- update ---------------------------------------------------------------------------------------


def update(state: State, batch: Batch, key: Key[Array, ""]) -> tuple[State, Metrics]:
    """Return the state after one gradient step of every network, and scalars to log."""
    encoding_key, target_key, action_key = jax.random.split(key, 3)
    done = optimizer.updates(state.critic_optimizer)
    observation, batch = encoders.encode_batch(state.encoder, batch, encoding_key)
    state, features, critic_metrics = update_critic(state, observation, batch, target_key)
    batch = batch._replace(observation=features)
    count = state.config.policy_every
    state, policy_metrics = beyond.every(done, count, update_policy, state, batch, action_key)
    target_critic = functional.target_update(
        state.critic, state.target_critic, state.config.target_update_rate
    )
    return replace(state, target_critic=target_critic), critic_metrics | policy_metrics


def update_critic(
    state: State, observation: Shaped[Array, "B ..."], batch: Batch, key: Key[Array, ""]
) -> tuple[State, Float[Array, "B S"], Metrics]:
    """Step the critics and the encoder; also return the features of the current observations."""
    target = critic_target(state, batch, jax.random.normal(key, batch.action.shape))
    state, (features, metrics) = optimizer.step_critic_and_encoder(
        critic_loss, state, observation, batch, target
    )
    return state, jax.lax.stop_gradient(features), metrics


def update_policy(state: State, batch: Batch, key: Key[Array, ""]) -> tuple[State, Metrics]:
    """Step the policy, then the entropy coefficient towards the target entropy -dim(A)."""
    noise = jax.random.normal(key, batch.action.shape)
    target = -float(state.spec.action_dim)
    return entropy.step_policy_and_coefficient(policy_loss, state, target, batch, noise)


# --- act and create -------------------------------------------------------------------------------


def act(
    state: State,
    observation: Shaped[Array, "B ..."],
    goal: Shaped[Array, "B ..."],
    key: Key[Array, ""],
    explore: bool,
) -> Float[Array, "B A"]:
    """Return actions in [-1, 1]: sampled where ``explore``, else the tanh of the mean."""
    return state.policy(state.encoder(observation), state.encoder(goal)).act(key, explore)


def create(config: Config, spec: EnvSpec, key: Key[Array, ""]) -> State:
    """Return networks at their random start; the target critics equal the critics."""
    encoder_key, critic_key, policy_key = jax.random.split(key, 3)
    keys = (encoder_key, critic_key, policy_key)
    encoder, critic, policy = beyond.actor_critic(config, spec, keys)
    log_entropy_coefficient = jnp.zeros(())
    return State(
        encoder=encoder,
        critic=critic,
        target_critic=functional.copy(critic),
        policy=policy,
        log_entropy_coefficient=log_entropy_coefficient,
        encoder_optimizer=optimizer.init(encoder),
        critic_optimizer=optimizer.init(critic),
        policy_optimizer=optimizer.init(policy),
        entropy_optimizer=optimizer.init(log_entropy_coefficient),
        config=config,
        spec=spec,
    )


AGENT = Agent(
    Config,
    create,
    update,
    act,
    networks=("encoder", "critic", "policy"),
    value=Value(encoders.on_observations(value), "value: minus discounted steps to the goal"),
    sampling=beyond.sampling,
    freezing=Freezing(lambda state: state.encoder),
)
