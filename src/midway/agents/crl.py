"""CRL: contrastive reinforcement learning (Eysenbach et al. 2022), online as in JaxGCRL.

The critic f(s, a, g) = -‖φ(s, a) - ψ(g)‖ tells the state that an action led to from those that
others led to, so that exp f is proportional to how likely g is met in the discounted future, over
how likely it is at all. There is no reward and no bootstrapping: goals of a batch are drawn from
the discounted future of its states (`RelabelMix.future_discount`). Of a goal, networks read the
coordinates that success is measured on: told to be at rest there as well, an agent that rests
anywhere looks nearer than one that moves.
"""

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Key, Shaped

from midway.agent import Agent, Freezing, Value
from midway.agents import entropy
from midway.networks import encoder as encoders
from midway.networks import inputs, optimizer
from midway.networks.encoder import Encoder
from midway.networks.inputs import PairInputs
from midway.networks.mlp import MLP, PRECISIONS, Precision
from midway.networks.policies import GaussianPolicy
from midway.settings import check, setting
from midway.types import Batch, EnvSpec, Metrics

SMALLEST_SQUARE = 1e-6
"""Added to squared distances, whose root has no gradient at 0."""


@dataclass(frozen=True)
class Config:
    """Hyperparameters of CRL; the defaults are those of JaxGCRL."""

    hidden: tuple[int, ...] = setting((256, 256), "JaxGCRL", "layers of every network", least=1)
    features: int = setting(64, "JaxGCRL", "length of φ and ψ", least=1)
    logsumexp_penalty: float = setting(0.1, "JaxGCRL", "of the squared log-sum-exp", least=0)
    random_goals: float = setting(0.5, "CRL", "share of the policy's goals", least=0, most=1)
    target_entropy: float = setting(-0.5, "JaxGCRL", "of the policy, for each action")
    critic_learning_rate: float = setting(3e-4, "JaxGCRL", "Adam, critic", above=0, most=1)
    policy_learning_rate: float = setting(6e-4, "JaxGCRL", "Adam, policy", above=0, most=1)
    entropy_learning_rate: float = setting(3e-4, "JaxGCRL", "Adam, log c", above=0, most=1)
    encoder_learning_rate: float = setting(1e-4, "code of RIS", "Adam, images", above=0, most=1)
    random_shift: int = setting(8, "appendix B", "of images, at most (pixels)", least=0)
    normalise: bool = setting(False, "none", "states by the environment's center and spread")
    image_pooling: int = setting(1, "not in the papers", "side of averaged squares", least=1)
    precision: Precision = setting("f32", "JaxGCRL", "of products", choices=PRECISIONS)

    def __post_init__(self) -> None:
        """Check the values, or raise a ConfigurationError."""
        check(self)


class ContrastiveCritic(eqx.Module):
    """f(s, a, g) = -‖φ(s, a) - ψ(g)‖, from two encoders of the same length."""

    state_action: MLP
    goal: MLP
    inputs: PairInputs

    def __call__(
        self,
        observation: Float[Array, "B S"],
        action: Float[Array, "B A"],
        goal: Float[Array, "B G"],
    ) -> Float[Array, " B"]:
        """Return f of each triple."""
        ours, theirs = self.state_action(observation, action), self.inputs(observation, goal)[1]
        return distance_logit(ours, self.goal(theirs))

    def logits(
        self,
        observation: Float[Array, "B S"],
        action: Float[Array, "B A"],
        goal: Float[Array, "B G"],
    ) -> Float[Array, "B B"]:
        """Return f of every state and action (rows) with every goal (columns)."""
        ours, theirs = self.state_action(observation, action), self.inputs(observation, goal)[1]
        return distance_logit(ours[:, None], self.goal(theirs)[None])


def distance_logit(
    ours: Float[Array, "*#B F"], theirs: Float[Array, "*#B F"]
) -> Float[Array, "*B"]:
    """Return -‖ours - theirs‖ over the last axis."""
    return -jnp.sqrt(((ours - theirs) ** 2).sum(-1) + SMALLEST_SQUARE)


class State(eqx.Module):
    """Networks, the logarithm of the entropy coefficient, and their optimisers."""

    encoder: Encoder
    critic: ContrastiveCritic
    policy: GaussianPolicy
    log_entropy_coefficient: Float[Array, ""]
    encoder_optimizer: optax.OptState
    critic_optimizer: optax.OptState
    policy_optimizer: optax.OptState
    entropy_optimizer: optax.OptState
    config: Config = eqx.field(static=True)
    spec: EnvSpec = eqx.field(static=True)


# --- losses ---------------------------------------------------------------------------------------


def infonce(logits: Float[Array, "B B"]) -> Float[Array, ""]:
    """Return the symmetric InfoNCE loss of logits whose diagonal holds the pairs that belong.

    Mean of the cross-entropies of rows and of columns, each against the diagonal.
    """
    own = jnp.diag(logits)
    rows, columns = (jax.nn.logsumexp(logits, axis=axis) for axis in (1, 0))
    return (rows - own).mean() + (columns - own).mean()


def critic_loss(
    networks: tuple[ContrastiveCritic, Encoder],
    observation: Shaped[Array, "B ..."],
    batch: Batch,
    penalty: float,
) -> tuple[Float[Array, ""], tuple[Float[Array, "B S"], Metrics]]:
    """Return InfoNCE + penalty * mean(logsumexp²), and the features of the observations."""
    critic, encoder = networks
    features = encoder(observation)
    logits = critic.logits(features, batch.action, batch.goal)
    normaliser = jax.nn.logsumexp(logits, axis=1)
    loss = infonce(logits) + penalty * (normaliser**2).mean()
    found = (logits.argmax(1) == jnp.arange(len(logits))).mean()
    metrics = {"critic/loss": loss, "critic/accuracy": found, "critic/logsumexp": normaliser.mean()}
    return loss, (features, metrics)


def policy_loss(
    policy: GaussianPolicy, state: State, batch: Batch, noise: Float[Array, "B A"]
) -> tuple[Float[Array, ""], tuple[Float[Array, ""], Metrics]]:
    """Return the mean of c log π_θ(a | s, g) - f(s, a, g), and the entropy estimate."""
    goal = policy_goals(batch.goal, state.config.random_goals)
    action, log_density = policy(batch.observation, goal).squashed(noise)
    logit = state.critic(batch.observation, action, goal)
    loss = (jnp.exp(state.log_entropy_coefficient) * log_density - logit).mean()
    estimate = -log_density.mean()
    return loss, (estimate, {"policy/loss": loss, "policy/entropy": estimate})


def policy_goals(goal: Float[Array, "B G"], random_share: float) -> Float[Array, "B G"]:
    """Return the goals with a share of them replaced by those of other transitions."""
    moved = jnp.arange(len(goal)) < random_share * len(goal)
    return jnp.where(moved[:, None], jnp.roll(goal, 1, axis=0), goal)


# --- update ---------------------------------------------------------------------------------------


def update(state: State, batch: Batch, key: Key[Array, ""]) -> tuple[State, Metrics]:
    """Return the state after one gradient step of every network, and scalars to log."""
    encoding_key, action_key = jax.random.split(key)
    observation, batch = encoders.encode_batch(state.encoder, batch, encoding_key)
    penalty = state.config.logsumexp_penalty
    state, (features, critic_metrics) = optimizer.step_critic_and_encoder(
        critic_loss, state, observation, batch, penalty
    )
    batch = batch._replace(observation=jax.lax.stop_gradient(features))
    state, policy_metrics = update_policy(state, batch, action_key)
    return state, critic_metrics | policy_metrics


def update_policy(state: State, batch: Batch, key: Key[Array, ""]) -> tuple[State, Metrics]:
    """Step the policy, then the entropy coefficient towards the target entropy."""
    noise = jax.random.normal(key, batch.action.shape)
    target = state.config.target_entropy * state.spec.action_dim
    return entropy.step_policy_and_coefficient(policy_loss, state, target, batch, noise)


# --- act and create -------------------------------------------------------------------------------


def value(
    state: State, observation: Float[Array, "B S"], goal: Float[Array, "B G"]
) -> Float[Array, " B"]:
    """Return f(s, a, g) at the deterministic action."""
    action = jnp.tanh(state.policy(observation, goal).mean)
    return state.critic(observation, action, goal)


def act(
    state: State,
    observation: Shaped[Array, "B ..."],
    goal: Shaped[Array, "B ..."],
    key: Key[Array, ""],
    explore: bool,
) -> Float[Array, "B A"]:
    """Return actions in [-1, 1]: sampled where ``explore``, else deterministic."""
    return state.policy(state.encoder(observation), state.encoder(goal)).act(key, explore)


def create(config: Config, spec: EnvSpec, key: Key[Array, ""]) -> State:
    """Return networks at their random start."""
    encoder_key, first_key, second_key, policy_key = jax.random.split(key, 4)
    observation_size, goal_size = encoders.feature_sizes(spec)
    encoder = encoders.create(spec, config, encoder_key)
    read = inputs.create(spec, "coordinates", encoder)
    goal_size = read.size(goal_size)

    def embed(size: int, key: Key[Array, ""]) -> MLP:
        return MLP(size, config.hidden, config.features, config.precision, key=key)

    critic = ContrastiveCritic(
        embed(observation_size + spec.action_dim, first_key), embed(goal_size, second_key), read
    )
    policy = GaussianPolicy(
        observation_size + goal_size,
        spec.action_dim,
        config.hidden,
        config.precision,
        key=policy_key,
        inputs=read,
    )
    log_entropy_coefficient = jnp.zeros(())
    return State(
        encoder=encoder,
        critic=critic,
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
    value=Value(encoders.on_observations(value), "contrastive critic: minus distance of features"),
    freezing=Freezing(lambda state: state.encoder),
)
