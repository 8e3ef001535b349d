"""RIS: reinforcement learning with imagined subgoals (ICML 2021, appendices A and B).

One update does, in this order: critics, subgoal policy, policy, target networks. Each step uses the
networks that the step before has just updated.
"""

from dataclasses import dataclass, replace
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Key, Shaped

from midway import functional
from midway.agent import Agent, Freezing, Inputs, SubgoalDistribution, Value
from midway.agents import beyond
from midway.networks import encoder as encoders
from midway.networks import optimizer
from midway.networks.critics import TwinCritic
from midway.networks.encoder import Encoder
from midway.networks.mlp import PRECISIONS, Precision
from midway.networks.policies import GaussianPolicy, SubgoalPolicy
from midway.settings import check, setting
from midway.types import Batch, EnvSpec, Metrics, Subgoal


@dataclass(frozen=True)
class Config(beyond.SubgoalSettings):
    """Hyperparameters of RIS; the defaults are table 1, ant navigation."""

    hidden: tuple[int, ...] = setting((256, 256), "table 1", "layers of every network", least=1)
    discount: float = setting(0.99, "table 1", "γ", above=0, below=1)
    target_update_rate: float = setting(0.005, "table 1", "τ", above=0, most=1)
    critic_learning_rate: float = setting(1e-3, "table 1", "Adam, critics", above=0, most=1)
    policy_learning_rate: float = setting(1e-3, "table 1", "Adam, policy", above=0, most=1)
    subgoal_learning_rate: float = setting(1e-4, "table 1", "Adam, subgoals", above=0, most=1)
    encoder_learning_rate: float = setting(1e-4, "original code", "Adam, images", above=0, most=1)
    random_shift: int = setting(8, "appendix B", "of images, at most (pixels)", least=0)
    image_pooling: int = setting(1, "not in the paper", "side of averaged squares", least=1)
    kl_weight: float = setting(0.1, "table 1", "α, of D_KL to the prior", least=0)
    advantage_temperature: float = setting(0.1, "table 1", "λ", above=0)
    num_subgoals: int = setting(10, "appendix B", "I, imagined for the prior", least=1)
    epsilon: float = setting(1e-16, "table 1", "ε, in the log of the prior", above=0, below=1)
    precision: Precision = setting("f32", "original code", "of products", choices=PRECISIONS)

    def __post_init__(self) -> None:
        """Check the values, or raise a ConfigurationError."""
        check(self)


class State(eqx.Module):
    """Networks, their target networks and their optimisers."""

    encoder: Encoder
    critic: TwinCritic
    target_critic: TwinCritic
    subgoal_policy: SubgoalPolicy
    policy: GaussianPolicy
    prior_policy: GaussianPolicy
    average_policy: GaussianPolicy | None
    encoder_optimizer: optax.OptState
    critic_optimizer: optax.OptState
    subgoal_optimizer: optax.OptState
    policy_optimizer: optax.OptState
    config: Config = eqx.field(static=True)
    spec: EnvSpec = eqx.field(static=True)


# --- losses -------------------------------------------------------------------------------------


def as_subgoal(
    state: State, observation: Float[Array, "*#B S"], predicted: Float[Array, "*B P"]
) -> Subgoal:
    """Return the subgoals that the subgoal policy's numbers stand for, in both of their roles."""
    return encoders.as_subgoal(state.spec, state.policy.inputs.embed(observation, predicted))


def critic_target(state: State, batch: Batch, noise: Float[Array, "B A"]) -> Float[Array, " B"]:
    """Return r + γ (1 - terminated) min Q'(s', a', g), a' ~ π_θ; there is no entropy term."""
    next_action = jnp.tanh(state.policy(batch.next_observation, batch.goal).sample(noise))
    next_q = state.target_critic(batch.next_observation, next_action, batch.goal)
    return beyond.n_step_target(batch, next_q.min(0), state.config)


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


def value(
    state: State, observation: Float[Array, "B S"], goal: Float[Array, "B G"]
) -> Float[Array, " B"]:
    """Return V(s, g): the smaller Q at the tanh of the policy's mean action."""
    action = jnp.tanh(state.policy(observation, goal).mean)
    return state.critic(observation, action, goal).min(0)


def subgoal_cost(state: State, batch: Batch, subgoal: Subgoal) -> Float[Array, " B"]:
    """Return max(|V(s, s_g)|, |V(s_g, g)|) of one subgoal for each pair."""
    return functional.subgoal_cost(
        value(state, batch.observation, subgoal.achieved_goal),
        value(state, subgoal.observation, batch.goal),
        functional.value_bound(state.config.discount),
    )


def subgoal_advantage(
    state: State, batch: Batch, mean_subgoal: Float[Array, "B S"]
) -> Float[Array, " B"]:
    """Return the cost of the current mean subgoal minus the cost of the candidate (A of eq. 11)."""
    mean = as_subgoal(state, batch.observation, mean_subgoal)
    return subgoal_cost(state, batch, mean) - subgoal_cost(state, batch, batch.subgoal_candidate)


def subgoal_loss(
    subgoal_policy: SubgoalPolicy, state: State, batch: Batch
) -> tuple[Float[Array, ""], Metrics]:
    """Return the weighted negative log-likelihood of the candidates (eq. 17)."""
    subgoals = subgoal_policy(batch.observation, batch.goal)
    advantage = jax.lax.stop_gradient(subgoal_advantage(state, batch, subgoals.location))
    weight = functional.advantage_weights(advantage, state.config.advantage_temperature)
    candidate = subgoal_policy.inputs.pick(encoders.as_vector(state.spec, batch.subgoal_candidate))
    loss = functional.subgoal_loss(subgoals.log_density(candidate), weight)
    return loss, {
        "subgoal/loss": loss,
        "subgoal/advantage": advantage.mean(),
        "subgoal/effective_candidates": 1 / (weight**2).sum(),
        "subgoal/scale": jnp.exp(subgoals.log_scale).mean(),
    }


def policy_loss(
    policy: GaussianPolicy,
    state: State,
    batch: Batch,
    noise: Float[Array, "B A"],
    imagined: Float[Array, "B I G"],
) -> tuple[Float[Array, ""], Metrics]:
    """Return the mean of α D_KL(π_θ || π_prior) - min Q (eq. 9 of the paper; eq. 18-19).

    The divergence is estimated on the action before the tanh, whose Jacobian cancels in it.
    """
    actions = policy(batch.observation, batch.goal)
    pre_tanh = actions.sample(noise)
    log_density = actions.log_density(pre_tanh)
    prior = state.prior_policy(batch.observation[:, None], imagined)
    prior_log_density = functional.prior_log_density(
        prior.log_density(pre_tanh[:, None]), state.config.epsilon
    )
    kl = functional.kl_estimate(log_density, prior_log_density)
    q = state.critic(batch.observation, jnp.tanh(pre_tanh), batch.goal).min(0)
    loss = functional.kl_policy_loss(kl, q, state.config.kl_weight)
    return loss, {
        "policy/loss": loss,
        "policy/kl_to_prior": kl.mean(),
        "policy/entropy": -log_density.mean(),
    }


# --- update ---------------------------------------------------------------------------------------


def update(state: State, batch: Batch, key: Key[Array, ""]) -> tuple[State, Metrics]:
    """Return the state after one gradient step of every network, and scalars to log."""
    encoding_key, target_key, *policy_keys = jax.random.split(key, 4)
    config, done = state.config, optimizer.updates(state.critic_optimizer)
    observation, batch = encoders.encode_batch(state.encoder, batch, encoding_key)
    state, features, critic_metrics = update_critic(state, observation, batch, target_key)
    batch = batch._replace(
        observation=features,
        subgoal_candidate=encoders.candidates(state.encoder, batch, features),
    )
    due = partial(beyond.every, done)
    state, subgoal_metrics = due(config.subgoal_every, update_subgoal_policy, state, batch)
    state, policy_metrics = due(config.policy_every, update_policy, state, batch, *policy_keys)
    return update_targets(state), critic_metrics | subgoal_metrics | policy_metrics


def update_critic(
    state: State, observation: Shaped[Array, "B ..."], batch: Batch, key: Key[Array, ""]
) -> tuple[State, Float[Array, "B S"], Metrics]:
    """Step the critics and the encoder; also return the features of the current observations."""
    target = critic_target(state, batch, jax.random.normal(key, batch.action.shape))
    state, (features, metrics) = optimizer.step_critic_and_encoder(
        critic_loss, state, observation, batch, target
    )
    return state, jax.lax.stop_gradient(features), metrics


def update_subgoal_policy(state: State, batch: Batch) -> tuple[State, Metrics]:
    """Step the subgoal policy towards good candidates."""
    config, old = state.config, (state.subgoal_policy, state.subgoal_optimizer)
    rate = optimizer.decayed(config.subgoal_learning_rate, config, old[1])
    network, adam, metrics = optimizer.minimise(subgoal_loss, *old, rate, state, batch)
    return replace(state, subgoal_policy=network, subgoal_optimizer=adam), metrics


def update_policy(
    state: State, batch: Batch, subgoal_key: Key[Array, ""], action_key: Key[Array, ""]
) -> tuple[State, Metrics]:
    """Step the policy against the value and the prior of imagined subgoals."""
    imagined = imagine(state, batch, subgoal_key).achieved_goal
    noise = jax.random.normal(action_key, batch.action.shape)
    config, old = state.config, (state.policy, state.policy_optimizer)
    rate = optimizer.decayed(config.policy_learning_rate, config, old[1])
    inputs = (state, batch, noise, imagined)
    network, adam, metrics = optimizer.minimise(policy_loss, *old, rate, *inputs)
    return replace(state, policy=network, policy_optimizer=adam), metrics


def imagine(state: State, batch: Batch, key: Key[Array, ""]) -> Subgoal:
    """Return I subgoals s_g^i ~ π^H_ψ(· | s, g) of each pair (eq. 18), without gradient."""
    subgoals = state.subgoal_policy(batch.observation, batch.goal)
    drawn = jax.lax.stop_gradient(subgoals.sample(key, state.config.num_subgoals))
    return as_subgoal(state, batch.observation[:, None], drawn)


def update_targets(state: State) -> State:
    """Move the target critics and the prior policy by τ (appendix B), the average by its rate."""
    rate, average = state.config.target_update_rate, state.average_policy
    if average is not None:
        average = functional.target_update(state.policy, average, state.config.policy_average_rate)
    return replace(
        state,
        average_policy=average,
        target_critic=functional.target_update(state.critic, state.target_critic, rate),
        prior_policy=functional.target_update(state.policy, state.prior_policy, rate),
    )


# --- act and create -------------------------------------------------------------------------------


def act(
    state: State, observation: Inputs, goal: Inputs, key: Key[Array, ""], explore: bool
) -> Float[Array, "B A"]:
    """Return actions in [-1, 1] of the flat policy: sampled where ``explore``, else the mean's.

    The mean is that of the averaged policy, where one is kept (``policy_average_rate``).
    """
    policy = state.policy if explore else state.average_policy or state.policy
    return policy(state.encoder(observation), state.encoder(goal)).act(key, explore)


def subgoal_distribution(state: State, observation: Inputs, goal: Inputs) -> SubgoalDistribution:
    """Return π^H_ψ(· | s, g) in the environment's units, one Laplace for each pair."""
    features = state.encoder(observation)
    subgoals = state.subgoal_policy(features, state.encoder(goal))
    location = as_subgoal(state, features, subgoals.location)
    scale = state.subgoal_policy.inputs.spread(features, jnp.exp(subgoals.log_scale))
    return SubgoalDistribution(
        Subgoal(*map(state.encoder.states, location)),
        Subgoal(*map(state.encoder.spread, encoders.as_subgoal(state.spec, scale))),
    )


def create(config: Config, spec: EnvSpec, key: Key[Array, ""]) -> State:
    """Return networks at their random start; the target networks equal the online ones."""
    encoder_key, critic_key, subgoal_key, policy_key = jax.random.split(key, 4)
    keys = (encoder_key, critic_key, policy_key)
    encoder, critic, policy = beyond.actor_critic(config, spec, keys)
    read = policy.inputs
    sizes = beyond.pair_size(spec, read), len(read.coordinates) or encoders.subgoal_size(spec)
    layers = (config.hidden, config.precision)
    subgoal_policy = SubgoalPolicy(
        *sizes, *layers, key=subgoal_key, inputs=read, custom=config.network
    )
    return State(
        encoder=encoder,
        critic=critic,
        target_critic=functional.copy(critic),
        subgoal_policy=subgoal_policy,
        policy=policy,
        prior_policy=functional.copy(policy),
        average_policy=functional.copy(policy) if config.policy_average_rate else None,
        encoder_optimizer=optimizer.init(encoder),
        critic_optimizer=optimizer.init(critic),
        subgoal_optimizer=optimizer.init(subgoal_policy),
        policy_optimizer=optimizer.init(policy),
        config=config,
        spec=spec,
    )


AGENT = Agent(
    Config,
    create,
    update,
    act,
    networks=("encoder", "critic", "subgoal_policy", "policy", "average_policy"),
    value=Value(encoders.on_observations(value), "value: minus discounted steps to the goal"),
    subgoals=subgoal_distribution,
    sampling=beyond.sampling,
    freezing=Freezing(lambda state: state.encoder),
)
