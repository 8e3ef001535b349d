"""The three stages of the RIS update against an independent implementation (tests/golden)."""

from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from midway import functional
from midway.agents import ris
from midway.networks.mlp import MLP
from midway.types import Batch, DistanceTask, EnvSpec, Subgoal

FILE = Path(__file__).parents[1] / "golden" / "golden_update.npz"
SPEC = EnvSpec("golden", (7,), "float32", (7,), 3, 100, True, None, DistanceTask(((0, 1),), 0.5))
TOLERANCE = 1e-4

# The layers of each network as the file names them; a tuple is one layer of ours.
HIDDEN = (("fc.0",), ("fc.2",))
POLICY = (*HIDDEN, ("mean_linear", "logstd_linear"))
SUBGOAL_POLICY = (*HIDDEN, ("mean", "log_scale"))
CRITICS = tuple(
    tuple((f"ensemble_Q.{i}.{layer}",) for layer in ("fc.0", "fc.2", "fc.4")) for i in range(2)
)
Layers = tuple[tuple[str, ...], ...]


@pytest.fixture(scope="module")
def golden() -> dict[str, np.ndarray]:
    with np.load(FILE) as file:
        return dict(file)


def arrays_of(golden: dict[str, np.ndarray], prefix: str, layers: Layers) -> list[np.ndarray]:
    """Return weight (in, out) and bias of each layer, as our networks hold them."""
    result = []
    for names in layers:
        weights = [golden[f"{prefix}/{name}.weight"].T for name in names]
        biases = [golden[f"{prefix}/{name}.bias"] for name in names]
        result += [np.concatenate(weights, 1), np.concatenate(biases)]
    return result


def arrays_in(network: MLP) -> list[jax.Array]:
    return [array for layer in network.layers for array in (layer.weight, layer.bias)]


def load(network: MLP, golden: dict[str, np.ndarray], prefix: str, layers: Layers) -> MLP:
    values = [jnp.asarray(array) for array in arrays_of(golden, prefix, layers)]
    assert [x.shape for x in values] == [x.shape for x in arrays_in(network)]
    return eqx.tree_at(arrays_in, network, values)


@pytest.fixture(scope="module")
def state(golden: dict[str, np.ndarray]) -> ris.State:
    discount, kl_weight, temperature, epsilon, num_subgoals = golden["constants"]
    config = ris.Config(
        hidden=(24, 24),
        discount=float(discount),
        kl_weight=float(kl_weight),
        advantage_temperature=float(temperature),
        epsilon=float(epsilon),
        num_subgoals=int(num_subgoals),
    )
    shapes = eqx.filter_eval_shape(ris.create, config, SPEC, jax.random.key(0))
    state = jax.tree.map(lambda x: jnp.asarray(np.zeros(x.shape, x.dtype)), shapes)
    networks = [
        ("policy", state.policy.network, POLICY),
        ("prior_policy", state.prior_policy.network, POLICY),
        ("subgoal_policy", state.subgoal_policy.network, SUBGOAL_POLICY),
        ("critic", state.critic.first, CRITICS[0]),
        ("critic", state.critic.second, CRITICS[1]),
        ("target_critic", state.target_critic.first, CRITICS[0]),
        ("target_critic", state.target_critic.second, CRITICS[1]),
    ]
    return eqx.tree_at(
        lambda s: [
            s.policy.network,
            s.prior_policy.network,
            s.subgoal_policy.network,
            *(s.critic.first, s.critic.second),
            *(s.target_critic.first, s.target_critic.second),
        ],
        state,
        [load(network, golden, f"weights/{name}", layers) for name, network, layers in networks],
    )


@pytest.fixture(scope="module")
def batch(golden: dict[str, np.ndarray]) -> Batch:
    fields = [name for name in Batch._fields if f"batch/{name}" in golden]
    values = {name: jnp.asarray(golden[f"batch/{name}"]) for name in fields}
    candidate = values.pop("subgoal_candidate")
    values["terminated"] = values["terminated"].astype(bool)
    return Batch(**values, subgoal_candidate=Subgoal(candidate, candidate))


def assert_close(ours: jax.Array, golden: np.ndarray) -> None:
    """Compare relative to the largest number of the array, and each number loosely to itself."""
    assert ours.shape == golden.shape
    np.testing.assert_allclose(ours, golden, rtol=0, atol=TOLERANCE * np.abs(golden).max())
    np.testing.assert_allclose(ours, golden, rtol=TOLERANCE, atol=1e-5 * np.abs(golden).max())


def assert_gradient(
    ours: MLP, golden: dict[str, np.ndarray], prefix: str, layers: Layers, factor: float = 1
) -> None:
    expected = arrays_of(golden, prefix, layers)
    for array, other in zip(arrays_in(ours), expected, strict=True):
        assert np.abs(other).max() > 0
        assert_close(array, factor * other)


def test_constants_are_those_of_table_1(state: ris.State):
    defaults = ris.Config()
    for name in ("discount", "kl_weight", "advantage_temperature", "epsilon", "num_subgoals"):
        assert getattr(state.config, name) == pytest.approx(getattr(defaults, name))
    assert functional.value_bound(state.config.discount) == pytest.approx(100)


@eqx.filter_jit
def gradient_of(loss, *arguments):
    return eqx.filter_value_and_grad(loss, has_aux=True)(*arguments)


def test_critic_target(state: ris.State, batch: Batch, golden: dict[str, np.ndarray]):
    @eqx.filter_jit
    def stage(noise):
        actions = state.policy(batch.next_observation, batch.goal)
        return jnp.tanh(actions.sample(noise)), ris.critic_target(state, batch, noise)

    next_action, target = stage(jnp.asarray(golden["critic/next_action_noise"]))
    assert_close(next_action, golden["critic/next_action"])
    assert_close(target, golden["critic/target"])
    assert 0 < golden["batch/terminated"].sum() < 48


def test_critic_loss_and_gradient(state: ris.State, batch: Batch, golden: dict[str, np.ndarray]):
    target = jnp.asarray(golden["critic/target"])
    networks = (state.critic, state.encoder)
    (loss, (features, metrics)), (gradient, _) = gradient_of(
        ris.critic_loss, networks, batch.observation, batch, target
    )
    assert_close(state.critic(batch.observation, batch.action, batch.goal), golden["critic/q"].T)
    assert_close(loss, golden["critic/loss"])
    assert_close(metrics["critic/loss"], golden["critic/loss"])
    assert_close(metrics["critic/q"], golden["critic/q"].mean())
    assert_close(metrics["critic/target"], golden["critic/target"].mean())
    np.testing.assert_array_equal(features, batch.observation)
    assert_gradient(gradient.first, golden, "critic/gradient", CRITICS[0])
    assert_gradient(gradient.second, golden, "critic/gradient", CRITICS[1])


def test_subgoal_intermediates(state: ris.State, batch: Batch, golden: dict[str, np.ndarray]):
    def cost(subgoal):
        return functional.subgoal_cost(
            ris.value(state, batch.observation, subgoal),
            ris.value(state, subgoal, batch.goal),
            functional.value_bound(state.config.discount),
        )

    @eqx.filter_jit
    def stage():
        subgoals = state.subgoal_policy(batch.observation, batch.goal)
        advantage = ris.subgoal_advantage(state, batch, subgoals.location)
        candidate = batch.subgoal_candidate.observation
        return {
            "location": subgoals.location,
            "scale": jnp.exp(subgoals.log_scale),
            "cost_of_mean": cost(subgoals.location),
            "cost_of_candidate": cost(candidate),
            "advantage": advantage,
            "weight": functional.advantage_weights(advantage, state.config.advantage_temperature),
            "log_likelihood": subgoals.log_density(candidate),
        }

    for name, ours in stage().items():
        assert_close(ours, golden[f"subgoal/{name}"])


def test_subgoal_loss_and_gradient(state: ris.State, batch: Batch, golden: dict[str, np.ndarray]):
    """Ours is the sum over the weights, 48 times the golden file's mean over the batch."""
    (loss, metrics), gradient = gradient_of(ris.subgoal_loss, state.subgoal_policy, state, batch)
    assert_close(loss, 48 * golden["subgoal/loss_mean_reduced"])
    assert_close(metrics["subgoal/loss"], 48 * golden["subgoal/loss_mean_reduced"])
    assert_close(metrics["subgoal/advantage"], golden["subgoal/advantage"].mean())
    assert_close(metrics["subgoal/effective_candidates"], 1 / (golden["subgoal/weight"] ** 2).sum())
    assert_close(metrics["subgoal/scale"], golden["subgoal/scale"].mean())
    assert_gradient(
        gradient.network, golden, "subgoal/gradient_mean_reduced", SUBGOAL_POLICY, factor=48
    )


def test_policy_intermediates(state: ris.State, batch: Batch, golden: dict[str, np.ndarray]):
    @eqx.filter_jit
    def stage(noise, imagined):
        actions = state.policy(batch.observation, batch.goal)
        pre_tanh = actions.sample(noise)
        prior = state.prior_policy(batch.observation[:, None], imagined)
        prior_log_density = functional.prior_log_density(
            prior.log_density(pre_tanh[:, None]), state.config.epsilon
        )
        return {
            "pre_tanh_action": pre_tanh,
            "prior_log_density": prior_log_density,
            "kl_to_prior": functional.kl_estimate(actions.log_density(pre_tanh), prior_log_density),
            "q": state.critic(batch.observation, jnp.tanh(pre_tanh), batch.goal).min(0),
        }

    arguments = (golden["policy/action_noise"], golden["policy/imagined_subgoals"])
    for name, ours in stage(*map(jnp.asarray, arguments)).items():
        assert_close(ours, golden[f"policy/{name}"])


def test_policy_loss_and_gradient(state: ris.State, batch: Batch, golden: dict[str, np.ndarray]):
    noise, imagined = golden["policy/action_noise"], golden["policy/imagined_subgoals"]
    (loss, metrics), gradient = gradient_of(
        ris.policy_loss, state.policy, state, batch, jnp.asarray(noise), jnp.asarray(imagined)
    )
    assert_close(loss, golden["policy/loss"])
    assert_close(metrics["policy/loss"], golden["policy/loss"])
    assert_close(metrics["policy/kl_to_prior"], golden["policy/kl_to_prior"].mean())
    assert_gradient(gradient.network, golden, "policy/gradient", POLICY)
