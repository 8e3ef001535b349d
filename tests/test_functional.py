"""Every formula against NumPy written from the paper, with numbers worked by hand."""

import hypothesis.extra.numpy as hnp
import hypothesis.strategies as st
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.special
import scipy.stats
from hypothesis import given, settings

from midway import functional

BATCH = 6
quick = settings(max_examples=25, deadline=None)


def floats(shape: tuple[int, ...], low: float, high: float) -> st.SearchStrategy[np.ndarray]:
    elements = st.floats(low, high, width=32, allow_subnormal=False)  # XLA flushes them to zero
    return hnp.arrays(np.float32, shape, elements=elements)


def array(*values: object) -> jax.Array:
    return jnp.asarray(values, jnp.float32)


# --- critic ---------------------------------------------------------------------------------------


def test_td_target_bootstraps_unless_terminated():
    target = functional.td_target(array(-1, -1), array(0, 1), array(-10, -10), 0.99)
    np.testing.assert_allclose(target, [-1 + 0.99 * -10, -1], rtol=1e-6)


def test_td_target_has_the_geometric_sum_as_its_fixed_point():
    """V = -(1 - γ^d) / (1 - γ) is worth -1 one step before the goal, -100 infinitely far."""
    discount, steps = 0.99, np.arange(1, 600)
    values = jnp.asarray(-(1 - discount**steps) / (1 - discount), jnp.float32)
    reward, running = jnp.full((len(steps) - 1,), -1.0), jnp.zeros((len(steps) - 1,))
    np.testing.assert_allclose(
        functional.td_target(reward, running, values[:-1], discount), values[1:], rtol=1e-5
    )
    assert values[0] == -1
    assert -100 < values[-1] < -99.7


def test_critic_loss_is_half_the_squares_summed_over_critics_averaged_over_the_batch():
    q, target = array([1, 2], [3, 4]), array(0, 1)
    # Errors (1, 1) and (3, 3): squares summed over the critics 10 and 10, half of it 5 and 5.
    assert functional.critic_loss(q, target) == 5


@quick
@given(floats((2, BATCH), -100, 0), floats((BATCH,), -100, 0))
def test_critic_loss_is_the_sum_of_both_losses(q, target):
    both = functional.critic_loss(jnp.asarray(q), jnp.asarray(target))
    expected = 0.5 * np.mean((q.astype(np.float64) - target) ** 2, axis=1).sum()
    np.testing.assert_allclose(both, expected, rtol=1e-5)


# --- subgoal policy -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("to_subgoal", "from_subgoal", "cost"),
    [
        (-3, -7, 7),  # the worse leg counts
        (-7, -3, 7),
        (2, -1, 1),  # a positive value is clipped to 0
        (5, 3, 0),
        (-150, -50, 100),  # a value below the bound is clipped to it
        (-20, -1e6, 100),
    ],
)
def test_subgoal_cost_is_the_worse_leg_with_values_clipped(to_subgoal, from_subgoal, cost):
    assert functional.subgoal_cost(array(to_subgoal), array(from_subgoal), 100.0)[0] == cost


@quick
@given(floats((BATCH,), -300, 300), floats((BATCH,), -300, 300))
def test_subgoal_cost_is_symmetric_and_within_its_bound(first, second):
    first, second = jnp.asarray(first), jnp.asarray(second)
    cost = functional.subgoal_cost(first, second, 100.0)
    assert bool(((cost >= 0) & (cost <= 100)).all())
    np.testing.assert_array_equal(cost, functional.subgoal_cost(second, first, 100.0))
    expected = [
        max(abs(min(0.0, max(-100.0, a))), abs(min(0.0, max(-100.0, b))))
        for a, b in zip(first.tolist(), second.tolist(), strict=True)
    ]
    np.testing.assert_allclose(cost, expected)


def test_advantage_weights_by_hand():
    """With advantages λ log 1, λ log 2, λ log 5 the exponentials are 1, 2, 5 and Z is 8."""
    advantage = 0.1 * np.log([1.0, 2.0, 5.0])
    weight = functional.advantage_weights(jnp.asarray(advantage, jnp.float32), 0.1)
    np.testing.assert_allclose(weight, [1 / 8, 2 / 8, 5 / 8], rtol=1e-5)


@quick
@given(floats((BATCH,), -100, 100), st.sampled_from([0.05, 0.1, 1.0, 10.0]))
def test_advantage_weights_sum_to_one_and_keep_the_order(advantage, temperature):
    weight = np.asarray(functional.advantage_weights(jnp.asarray(advantage), temperature))
    assert weight.sum() == pytest.approx(1, abs=1e-5)
    assert (weight >= 0).all()
    assert (np.diff(weight[np.argsort(advantage)]) >= 0).all()
    expected = scipy.special.softmax(advantage.astype(np.float64) / temperature)
    np.testing.assert_allclose(weight, expected, rtol=2e-3, atol=1e-6)


def test_subgoal_loss_by_hand():
    # 0.5 * 1 + 0.25 * 2 + 0.25 * 4
    assert functional.subgoal_loss(array(-1, -2, -4), array(0.5, 0.25, 0.25)) == 2


# --- policy ---------------------------------------------------------------------------------------


def test_prior_log_density_by_hand():
    densities = jnp.log(array([0.2, 0.4], [1.0, 3.0]))
    prior = functional.prior_log_density(densities, 0.1)
    np.testing.assert_allclose(prior, np.log([0.3 + 0.1, 2.0 + 0.1]), rtol=1e-5)


@pytest.mark.parametrize("epsilon", [1e-16, 1e-4])
def test_prior_log_density_ends_at_log_epsilon_for_impossible_actions(epsilon):
    prior = functional.prior_log_density(jnp.full((1, 10), -5000.0), epsilon)
    assert prior[0] == pytest.approx(np.log(epsilon), rel=1e-6)


def test_prior_log_density_of_huge_densities_does_not_overflow():
    prior = functional.prior_log_density(array([1000, 1000], [1000, -1000]), 1e-16)
    np.testing.assert_allclose(prior, [1000, 1000 - np.log(2)], rtol=1e-6)


@quick
@given(
    floats((BATCH, 10), -1e4, 1e4),
    st.sampled_from([1e-16, 1e-4]),
    st.permutations(list(range(10))),
)
def test_prior_log_density_lies_between_its_bounds(log_densities, epsilon, order):
    prior = np.asarray(functional.prior_log_density(jnp.asarray(log_densities), epsilon))
    slack = 1e-5 * (1 + np.abs(log_densities).max())
    lowest, highest = log_densities.min(1), log_densities.max(1)
    assert np.isfinite(prior).all()
    assert (prior >= np.log(epsilon) - slack).all()
    assert (prior >= lowest - slack).all()
    assert (prior <= np.logaddexp(highest, np.log(epsilon)) + slack).all()
    shuffled = functional.prior_log_density(jnp.asarray(log_densities[:, order]), epsilon)
    np.testing.assert_allclose(shuffled, prior, rtol=1e-5, atol=1e-4)


@quick
@given(floats((BATCH, 10), -30, 10), st.sampled_from([1e-16, 1e-4]))
def test_prior_log_density_equals_the_plain_formula(log_densities, epsilon):
    prior = functional.prior_log_density(jnp.asarray(log_densities), epsilon)
    plain = np.log(np.exp(log_densities.astype(np.float64)).mean(1) + epsilon)
    np.testing.assert_allclose(prior, plain, rtol=1e-5, atol=1e-5)


@quick
@given(floats((BATCH, 10), -1e4, 1e4), st.sampled_from([1e-16, 1e-4]))
def test_prior_log_density_gradient_is_the_share_of_each_subgoal(log_densities, epsilon):
    gradient = jax.grad(lambda x: functional.prior_log_density(x, epsilon).sum())
    shares = np.asarray(gradient(jnp.asarray(log_densities)))
    wide = log_densities.astype(np.float64)
    total = np.logaddexp(scipy.special.logsumexp(wide, axis=1), np.log(10) + np.log(epsilon))
    np.testing.assert_allclose(shares, np.exp(wide - total[:, None]), rtol=5e-3, atol=1e-6)


def test_kl_estimate_and_policy_loss_by_hand():
    kl = functional.kl_estimate(array(2, 5), array(1, 2))
    np.testing.assert_array_equal(kl, [1, 3])
    loss = functional.kl_policy_loss(kl, array(-2, -4), 0.1)
    assert loss == pytest.approx(((0.1 * 1 + 2) + (0.1 * 3 + 4)) / 2)


def test_kl_estimate_averages_to_the_divergence_of_two_gaussians():
    """D_KL(N(0, 1) || N(1, 2²)) = log 2 + (1 + 1) / (2 * 4) - 1/2."""
    x = jnp.asarray(np.random.default_rng(0).normal(size=(100_000, 1)), jnp.float32)
    zero, one = jnp.zeros_like(x), jnp.ones_like(x)
    own = functional.gaussian_log_density(x, zero, zero)
    prior = functional.gaussian_log_density(x, one, one * jnp.log(2.0))
    expected = np.log(2) + 2 / 8 - 1 / 2
    assert functional.kl_estimate(own, prior).mean() == pytest.approx(expected, abs=0.01)


# --- copies ---------------------------------------------------------------------------------------


def test_target_update_by_hand():
    moved = functional.target_update({"w": array(10)}, {"w": array(2)}, 0.005)
    assert moved["w"][0] == pytest.approx(0.005 * 10 + 0.995 * 2)


@quick
@given(floats((BATCH,), -100, 100), floats((BATCH,), -100, 100), st.floats(0, 1))
def test_target_update_reaches_both_endpoints_and_stays_between(online, target, rate):
    online, target = jnp.asarray(online), jnp.asarray(target)
    np.testing.assert_array_equal(functional.target_update(online, target, 0.0), target)
    np.testing.assert_array_equal(functional.target_update(online, target, 1.0), online)
    moved = functional.target_update(online, target, rate)
    low, high = jnp.minimum(online, target), jnp.maximum(online, target)
    assert bool(((moved >= low - 1e-4) & (moved <= high + 1e-4)).all())


def test_target_update_leaves_anything_but_floats_alone():
    online = {"count": jnp.asarray(3), "name": "online", "w": array(1)}
    target = {"count": jnp.asarray(5), "name": "target", "w": array(0)}
    moved = functional.target_update(online, target, 0.5)
    assert moved["count"] == 5
    assert moved["name"] == "target"
    assert moved["w"][0] == 0.5


def test_copy_has_arrays_of_its_own():
    original = {"w": array(1, 2), "name": "w"}
    other = functional.copy(original)
    np.testing.assert_array_equal(other["w"], original["w"])
    assert other["name"] == "w"
    assert other["w"].unsafe_buffer_pointer() != original["w"].unsafe_buffer_pointer()


# --- densities ------------------------------------------------------------------------------------


def test_densities_by_hand():
    origin, wide = array([0, 0]), jnp.log(array([2, 2]))
    standard = functional.gaussian_log_density(origin, origin, origin)
    assert standard[0] == pytest.approx(-np.log(2 * np.pi))
    # Two coordinates, each at distance 4 with scale 2: -|x| / b - log(2 b) = -2 - log 4.
    laplace = functional.laplace_log_density(array([4, -4]), origin, wide)
    assert laplace[0] == pytest.approx(2 * (-2 - np.log(4)))


@quick
@given(floats((4, 3), -5, 5), floats((4, 3), -5, 5), floats((4, 3), -4, 2))
def test_densities_equal_those_of_scipy(x, location, log_scale):
    given_to_ours = (jnp.asarray(x), jnp.asarray(location), jnp.asarray(log_scale))
    location, scale = location.astype(np.float64), np.exp(log_scale.astype(np.float64))
    np.testing.assert_allclose(
        functional.gaussian_log_density(*given_to_ours),
        scipy.stats.norm.logpdf(x, location, scale).sum(1),
        rtol=1e-5,
        atol=1e-4,
    )
    np.testing.assert_allclose(
        functional.laplace_log_density(*given_to_ours),
        scipy.stats.laplace.logpdf(x, location, scale).sum(1),
        rtol=1e-5,
        atol=1e-4,
    )


def test_densities_keep_leading_axes():
    x, location = jnp.zeros((5, 10, 3)), jnp.zeros((5, 10, 3))
    assert functional.gaussian_log_density(x, location, location).shape == (5, 10)
    assert functional.laplace_log_density(x, location, location).shape == (5, 10)
    assert functional.tanh_log_determinant(x).shape == (5, 10)


@pytest.mark.parametrize(
    "log_density", [functional.gaussian_log_density, functional.laplace_log_density]
)
def test_densities_broadcast_one_action_against_the_subgoals(log_density):
    """An action (B, 1, A) against the ten distributions (B, 10, A) of eq. 18."""
    rng = np.random.default_rng(0)
    x = jnp.asarray(rng.normal(size=(5, 1, 3)), jnp.float32)
    location = jnp.asarray(rng.normal(size=(5, 10, 3)), jnp.float32)
    together = log_density(x, location, 0.1 * location)
    apart = log_density(jnp.tile(x, (1, 10, 1)), location, 0.1 * location)
    np.testing.assert_allclose(together, apart, rtol=1e-6)


def test_tanh_log_determinant_by_hand():
    """The derivative of tanh is 1 - tanh²: 1 at 0, 3/4 where tanh is 1/2."""
    half = float(np.arctanh(0.5))
    result = functional.tanh_log_determinant(array([0, 0], [half, 0], [half, -half]))
    np.testing.assert_allclose(result, [0, np.log(0.75), 2 * np.log(0.75)], atol=1e-6)


@quick
@given(floats((BATCH, 1), -3, 3))
def test_tanh_log_determinant_equals_the_numerical_derivative(pre_tanh):
    wide, step = pre_tanh.astype(np.float64), 1e-6
    slope = (np.tanh(wide + step) - np.tanh(wide - step)) / (2 * step)
    result = functional.tanh_log_determinant(jnp.asarray(pre_tanh))
    np.testing.assert_allclose(result, np.log(slope)[:, 0], rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("pre_tanh", [-1000.0, -40.0, 40.0, 1000.0])
def test_tanh_log_determinant_is_finite_where_tanh_is_flat(pre_tanh):
    log_determinant = jax.value_and_grad(functional.tanh_log_determinant)
    value, slope = log_determinant(array(pre_tanh))
    # 1 - tanh² = 4 e^(-2|u|) for large |u|.
    assert value == pytest.approx(np.log(4) - 2 * abs(pre_tanh))
    assert slope[0] == pytest.approx(-2 * np.sign(pre_tanh))
