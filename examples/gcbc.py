"""Goal-conditioned behavioural cloning: an agent of your own, in one file outside the package.

    midway train point-u --agent gcbc:AGENT        (with this folder on PYTHONPATH)

It imitates its own past: the action that was followed by reaching a goal is the one to repeat for
that goal. Hindsight relabelling turns every episode into demonstrations (Ghosh et al. 2021,
"Learning to reach goals via iterated supervised learning").
"""

from dataclasses import dataclass, replace

import equinox as eqx
import jax.numpy as jnp
import optax

from midway.agent import Agent
from midway.networks import encoder as encoders
from midway.networks import optimizer
from midway.networks.encoder import StateEncoder
from midway.networks.policies import GaussianPolicy
from midway.settings import check, setting

LARGEST_ACTION = 0.999
"""Actions at ±1 lie at infinity before the tanh."""


@dataclass(frozen=True)
class Config:
    """Hyperparameters; every field has a default, which ``--set`` and presets may change."""

    hidden: tuple[int, ...] = setting((256, 256), "ours", "layers of the policy", least=1)
    policy_learning_rate: float = setting(1e-3, "ours", "Adam, policy", above=0, most=1)

    def __post_init__(self) -> None:
        check(self)


class State(eqx.Module):
    """What is learned: arrays in modules. Configuration and specification are static parts."""

    encoder: StateEncoder
    policy: GaussianPolicy
    policy_optimizer: optax.OptState
    config: Config = eqx.field(static=True)
    spec: object = eqx.field(static=True)


def create(config, spec, key):
    """Return networks at their random start, for the sizes that the specification gives."""
    encoder = encoders.create(spec, config, key)
    inputs = sum(encoders.feature_sizes(spec))
    policy = GaussianPolicy(inputs, spec.action_dim, config.hidden, "f32", key=key)
    return State(encoder, policy, optimizer.init(policy), config, spec)


def policy_loss(policy, batch):
    """Return the negative log-likelihood of the actions, given state and relabelled goal."""
    actions = jnp.clip(batch.action, -LARGEST_ACTION, LARGEST_ACTION)
    log_density = policy(batch.observation, batch.goal).log_density(jnp.arctanh(actions))
    loss = -log_density.mean()
    return loss, {"policy/loss": loss}


def update(state, batch, key):
    """Return the state after one gradient step, and scalars to log."""
    observation, batch = encoders.encode_batch(state.encoder, batch, key)
    batch = batch._replace(observation=state.encoder(observation))
    policy, adam, metrics = optimizer.minimise(
        policy_loss,
        state.policy,
        state.policy_optimizer,
        state.config.policy_learning_rate,
        batch,
    )
    return replace(state, policy=policy, policy_optimizer=adam), metrics


def act(state, observation, goal, key, explore):
    """Return actions in [-1, 1]: sampled where ``explore``, else deterministic."""
    return state.policy(state.encoder(observation), state.encoder(goal)).act(key, explore)


AGENT = Agent(Config, create, update, act, networks=("encoder", "policy"))
