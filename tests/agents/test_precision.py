"""Products in bfloat16 against float32: how far off the gradients of RIS may be.

The measure is the Euclidean norm of the difference, over all numbers of a network's gradient
together, divided by the norm of the float32 gradient.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from midway.agents import ris
from midway.types import DistanceTask, EnvSpec

SPEC = EnvSpec("ant", (31,), "float32", (31,), 8, 600, True, None, DistanceTask(((0, 1),), 0.5))
KEY = jax.random.key(0)
BOUND = 0.05


@eqx.filter_jit
def gradients(state: ris.State, batch, noise) -> dict[str, jax.Array]:
    """Return the gradient of each stage as one vector."""

    def gradient_of(loss, *arguments):
        gradient, _ = eqx.filter_grad(loss, has_aux=True)(*arguments)
        return jnp.concatenate([x.ravel() for x in jax.tree.leaves(gradient)])

    target = ris.critic_target(state, batch, noise)
    imagined = ris.imagine(state, batch, KEY).achieved_goal
    networks = (state.critic, state.encoder)
    return {
        "critic": gradient_of(ris.critic_loss, networks, batch.observation, batch, target),
        "subgoal": gradient_of(ris.subgoal_loss, state.subgoal_policy, state, batch),
        "policy": gradient_of(ris.policy_loss, state.policy, state, batch, noise, imagined),
    }


def critic_ends(state: ris.State):
    last = [network.layers[-1] for network in (state.critic.first, state.critic.second)]
    return [*(layer.weight for layer in last), *(layer.bias for layer in last)]


@pytest.fixture(scope="module", params=["fresh", "spread"])
def pair(request, make_batch):
    """Gradients in both precisions, at the start and with values spread over [-100, 0].

    A spread of values is the harder case for the subgoal policy: their errors are divided by the
    advantage temperature before the softmax.
    """
    batch = make_batch(SPEC, 256)
    noise = jnp.asarray(np.random.default_rng(1).normal(size=batch.action.shape), jnp.float32)
    result = []
    for precision in ("f32", "bf16"):
        state = ris.create(ris.Config(precision=precision), SPEC, KEY)
        if request.param == "spread":
            spread = [100 * x for x in critic_ends(state)]
            spread[2:] = [bias - 50 for bias in spread[2:]]
            state = eqx.tree_at(critic_ends, state, spread)
        result.append(gradients(state, batch, noise))
    return result


@pytest.mark.parametrize("stage", ["critic", "subgoal", "policy"])
def test_gradients_of_half_precision_products_are_within_five_percent(pair, stage):
    exact, rounded = (np.asarray(gradients[stage], float) for gradients in pair)
    error = np.linalg.norm(rounded - exact) / np.linalg.norm(exact)
    assert error < BOUND
    assert error > 1e-4  # the products were indeed rounded
    cosine = rounded @ exact / np.linalg.norm(rounded) / np.linalg.norm(exact)
    assert cosine > 1 - BOUND**2
