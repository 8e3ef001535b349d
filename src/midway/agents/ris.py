"""RIS: reinforcement learning with imagined subgoals (ICML 2021, appendices A and B).

One update does, in this order: critics, subgoal policy, policy, Polyak copies. Each step uses the
networks that the step before has just updated.
"""

from dataclasses import dataclass, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Key, Shaped

from midway import functional
from midway.networks import encoder as encoders
from midway.networks import optimizer
from midway.networks.critics import TwinCritic
from midway.networks.encoder import Encoder, StateEncoder
from midway.networks.mlp import Precision
from midway.networks.policies import GaussianPolicy, SubgoalPolicy
from midway.types import Batch, EnvSpec, Metrics, Subgoal


@dataclass(frozen=True)
class Config:
    """Hyperparameters of RIS; the defaults are table 1, ant navigation.

    Attributes:
        hidden: Hidden layers of every network.
        discount: γ.
        target_update_rate: τ, of the target critics and the prior policy.
        critic_learning_rate: Adam's rate for the critics.
        policy_learning_rate: Adam's rate for the policy.
        subgoal_learning_rate: Adam's rate for the subgoal policy.
        encoder_learning_rate: Adam's rate for the image encoder (original code).
        encoder_updates: Updates after which the encoder stays as it is and images are no longer
            translated; 0 for never, as in the paper.
        image_translation: Largest random translation of an image along each axis (pixels).
        image_pooling: Side of the squares of pixels that the encoder averages first (ours).
        kl_weight: α, the weight of the KL divergence to the prior.
        advantage_temperature: λ, of the weights of subgoal candidates.
        num_subgoals: I, subgoals imagined for the prior (eq. 18).
        epsilon: ε inside the logarithm of the prior (eq. 18).
        precision: Products in ``f32`` or ``bf16``; everything else is float32.
    """

    hidden: tuple[int, ...] = (256, 256)
    discount: float = 0.99
    target_update_rate: float = 0.005
    critic_learning_rate: float = 1e-3
    policy_learning_rate: float = 1e-3
    subgoal_learning_rate: float = 1e-4
    encoder_learning_rate: float = 1e-4
    encoder_updates: int = 0
    image_translation: int = 8
    image_pooling: int = 1
    kl_weight: float = 0.1
    advantage_temperature: float = 0.1
    num_subgoals: int = 10
    epsilon: float = 1e-16
    precision: Precision = "f32"

    @property
    def value_bound(self) -> float:
        """The largest number of discounted steps, 1 / (1 - γ): values lie in [-bound, 0]."""
        return 1 / (1 - self.discount)


class State(eqx.Module):
    """Networks, their Polyak copies and their optimisers."""

    encoder: Encoder
    critic: TwinCritic
    target_critic: TwinCritic
    subgoal_policy: SubgoalPolicy
    policy: GaussianPolicy
    prior_policy: GaussianPolicy
    encoder_optimizer: optax.OptState
    critic_optimizer: optax.OptState
    subgoal_optimizer: optax.OptState
    policy_optimizer: optax.OptState
    config: Config = eqx.field(static=True)
    spec: EnvSpec = eqx.field(static=True)


NETWORKS = ("encoder", "critic", "target_critic", "subgoal_policy", "policy", "prior_policy")
"""The parts of the state that a saved policy holds."""


# --- the two roles of a subgoal -------------------------------------------------------------------


def as_subgoal(spec: EnvSpec, vector: Float[Array, "*B S"]) -> Subgoal:
    """Split a predicted vector into the state it is started from and the goal it is reached as."""
    if spec.goal_is_observation:
        return Subgoal(vector, vector)
    size = encoders.code_sizes(spec)[0]
    return Subgoal(vector[..., :size], vector[..., size:])


def as_vector(spec: EnvSpec, subgoal: Subgoal) -> Float[Array, "*B S"]:
    """Join both roles of a subgoal into the vector that the subgoal policy predicts."""
    if spec.goal_is_observation:
        return subgoal.observation
    return jnp.concatenate(subgoal, axis=-1)


def subgoal_candidates(encoder: Encoder, batch: Batch, code: Float[Array, "B S"]) -> Subgoal:
    """Return the codes of the states drawn from replay as candidates (eq. 17).

    For images these are the codes of the batch's own observations, each beside another transition:
    they are as uniform draws from replay as any, and need no further pass through the encoder.
    """
    if isinstance(encoder, StateEncoder):
        return Subgoal(*map(encoder, batch.subgoal_candidate))
    shifted = jnp.roll(code, 1, axis=0)
    return Subgoal(shifted, shifted)


# --- losses ---------------------------------------------------------------------------------------


def critic_target(state: State, batch: Batch, noise: Float[Array, "B A"]) -> Float[Array, " B"]:
    """Return r + γ (1 - terminated) min Q'(s', a', g), a' ~ π_θ; there is no entropy term."""
    next_action = jnp.tanh(state.policy(batch.next_observation, batch.goal).sample(noise))
    next_q = state.target_critic(batch.next_observation, next_action, batch.goal)
    terminated = batch.terminated.astype(jnp.float32)
    return functional.td_target(batch.reward, terminated, next_q.min(0), state.config.discount)


def critic_loss(
    networks: tuple[TwinCritic, Encoder],
    observation: Shaped[Array, "B ..."],
    batch: Batch,
    target: Float[Array, " B"],
) -> tuple[Float[Array, ""], tuple[Float[Array, "B S"], Metrics]]:
    """Return the loss of the critics, and the codes of the current observations.

    Only the current observation is encoded with gradient; the batch holds fixed codes.
    """
    critic, encoder = networks
    code = encoder(observation)
    q = critic(code, batch.action, batch.goal)
    loss = functional.critic_loss(q, target)
    return loss, (code, {"critic/loss": loss, "critic/q": q.mean(), "critic/target": target.mean()})


def value(
    state: State, observation: Float[Array, "B S"], goal: Float[Array, "B G"]
) -> Float[Array, " B"]:
    """Return V(s, g): the smaller Q at the tanh of the policy's mean action."""
    action = jnp.tanh(state.policy(observation, goal).mean)
    return state.critic(observation, action, goal).min(0)


def subgoal_advantage(
    state: State, batch: Batch, mean_subgoal: Float[Array, "B S"]
) -> Float[Array, " B"]:
    """Return the cost of the current mean subgoal minus the cost of the candidate."""

    def cost(subgoal: Subgoal) -> Float[Array, " B"]:
        return functional.subgoal_cost(
            value(state, batch.observation, subgoal.achieved_goal),
            value(state, subgoal.observation, batch.goal),
            state.config.value_bound,
        )

    return cost(as_subgoal(state.spec, mean_subgoal)) - cost(batch.subgoal_candidate)


def subgoal_loss(
    subgoal_policy: SubgoalPolicy, state: State, batch: Batch
) -> tuple[Float[Array, ""], Metrics]:
    """Return the weighted negative log-likelihood of the candidates (eq. 17)."""
    subgoals = subgoal_policy(batch.observation, batch.goal)
    advantage = jax.lax.stop_gradient(subgoal_advantage(state, batch, subgoals.location))
    weight = functional.advantage_weights(advantage, state.config.advantage_temperature)
    candidate = as_vector(state.spec, batch.subgoal_candidate)
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
    """Return the mean of α D_KL(π_θ || π_prior) - min Q (eq. 18-19).

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
    encoding_key, target_key, subgoal_key, action_key = jax.random.split(key, 4)
    done = optimizer.updates(state.critic_optimizer)
    learns = encoders.learns(state.encoder, state.config, batch.observation, done)
    observation, batch = encoders.encode_fixed(state.encoder, batch, learns, encoding_key)
    state, code, critic_metrics = update_critic(state, observation, batch, target_key)
    batch = batch._replace(
        observation=code, subgoal_candidate=subgoal_candidates(state.encoder, batch, code)
    )
    state, subgoal_metrics = update_subgoal_policy(state, batch)
    state, policy_metrics = update_policy(state, batch, subgoal_key, action_key)
    return update_copies(state), critic_metrics | subgoal_metrics | policy_metrics


def update_critic(
    state: State, observation: Shaped[Array, "B ..."], batch: Batch, key: Key[Array, ""]
) -> tuple[State, Float[Array, "B S"], Metrics]:
    """Step the critics and the encoder; also return the codes of the current observations."""
    target = critic_target(state, batch, jax.random.normal(key, batch.action.shape))
    done = optimizer.updates(state.critic_optimizer)
    learns = encoders.learns(state.encoder, state.config, observation, done)
    state, (code, metrics) = optimizer.step_critic_and_encoder(
        critic_loss, state, learns, observation, batch, target
    )
    return state, jax.lax.stop_gradient(code), metrics


def update_subgoal_policy(state: State, batch: Batch) -> tuple[State, Metrics]:
    """Step the subgoal policy towards good candidates."""
    gradient_of = eqx.filter_value_and_grad(subgoal_loss, has_aux=True)
    (_, metrics), gradient = gradient_of(state.subgoal_policy, state, batch)
    network, optimizer_state = optimizer.step(
        state.subgoal_policy, gradient, state.subgoal_optimizer, state.config.subgoal_learning_rate
    )
    return replace(state, subgoal_policy=network, subgoal_optimizer=optimizer_state), metrics


def update_policy(
    state: State, batch: Batch, subgoal_key: Key[Array, ""], action_key: Key[Array, ""]
) -> tuple[State, Metrics]:
    """Step the policy against the value and the prior of imagined subgoals."""
    imagined = imagine(state, batch.observation, batch.goal, subgoal_key)
    noise = jax.random.normal(action_key, batch.action.shape)
    gradient_of = eqx.filter_value_and_grad(policy_loss, has_aux=True)
    (_, metrics), gradient = gradient_of(state.policy, state, batch, noise, imagined.achieved_goal)
    network, optimizer_state = optimizer.step(
        state.policy, gradient, state.policy_optimizer, state.config.policy_learning_rate
    )
    return replace(state, policy=network, policy_optimizer=optimizer_state), metrics


def imagine(
    state: State,
    observation: Float[Array, "B S"],
    goal: Float[Array, "B G"],
    key: Key[Array, ""],
) -> Subgoal:
    """Return I subgoals s_g^i ~ π^H_ψ(· | s, g) for each pair, ``(B, I, S)``, without gradient."""
    subgoals = state.subgoal_policy(observation, goal).sample(key, state.config.num_subgoals)
    return as_subgoal(state.spec, jax.lax.stop_gradient(subgoals))


def update_copies(state: State) -> State:
    """Move the target critics and the prior policy by τ (appendix B)."""
    rate = state.config.target_update_rate
    return replace(
        state,
        target_critic=functional.polyak_update(state.critic, state.target_critic, rate),
        prior_policy=functional.polyak_update(state.policy, state.prior_policy, rate),
    )


# --- act and create -------------------------------------------------------------------------------


def act(
    state: State,
    observation: Shaped[Array, "B ..."],
    goal: Shaped[Array, "B ..."],
    key: Key[Array, ""],
    explore: bool,
) -> Float[Array, "B A"]:
    """Return actions in [-1, 1] of the flat policy: sampled where ``explore``, else the mean's."""
    actions = state.policy(state.encoder(observation), state.encoder(goal))
    if not explore:
        return jnp.tanh(actions.mean)
    return jnp.tanh(actions.sample(jax.random.normal(key, actions.mean.shape)))


def create(config: Config, spec: EnvSpec, key: Key[Array, ""]) -> State:
    """Return networks at their random start; the copies equal their originals."""
    encoder_key, critic_key, subgoal_key, policy_key = jax.random.split(key, 4)
    observation_size, goal_size = encoders.code_sizes(spec)
    subgoal_size = observation_size if spec.goal_is_observation else observation_size + goal_size
    pair = observation_size + goal_size
    encoder = encoders.create(spec, config, encoder_key)
    critic = TwinCritic(pair + spec.action_dim, config.hidden, config.precision, key=critic_key)
    subgoal_policy = SubgoalPolicy(
        pair, subgoal_size, config.hidden, config.precision, key=subgoal_key
    )
    policy = GaussianPolicy(pair, spec.action_dim, config.hidden, config.precision, key=policy_key)
    return State(
        encoder=encoder,
        critic=critic,
        target_critic=functional.copy(critic),
        subgoal_policy=subgoal_policy,
        policy=policy,
        prior_policy=functional.copy(policy),
        encoder_optimizer=optimizer.init(encoder),
        critic_optimizer=optimizer.init(critic),
        subgoal_optimizer=optimizer.init(subgoal_policy),
        policy_optimizer=optimizer.init(policy),
        config=config,
        spec=spec,
    )
