"""Learning rates that decay."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import optax
import pytest
from hypothesis import given
from hypothesis import strategies as st

from midway.agents import crl, ris, sac
from midway.networks import optimizer


def adam(updates: int) -> optax.OptState:
    return optax.tree_utils.tree_set(optimizer.init(jnp.zeros(2)), count=jnp.asarray(updates))


@given(updates=st.integers(0, 10**6), after=st.integers(1, 10**6))
def test_rates_fall_with_the_inverse_of_time(updates: int, after: int) -> None:
    """A half after N updates, a third after 2 N: η / (1 + t / N), by hand."""
    rate = optimizer.decayed(3e-4, ris.Config(halve_rates_after=after), adam(updates))
    np.testing.assert_allclose(rate, 3e-4 * after / (after + updates), rtol=1e-5)


@pytest.mark.parametrize("config", [ris.Config(), sac.Config(), crl.Config()])
def test_rates_stay_where_nothing_is_said(config: object) -> None:
    """The number itself: the paper's updates are compiled as they were."""
    assert optimizer.decayed(3e-4, config, adam(1_000)) == 3e-4
    assert isinstance(optimizer.decayed(3e-4, config, adam(1_000)), float)


def test_a_step_with_a_decayed_rate_is_as_much_shorter() -> None:
    network, gradient, state = jnp.zeros(2), jnp.asarray([1.0, -2.0]), adam(50)
    whole, _ = optimizer.step(network, gradient, state, 0.1)
    config = replace(ris.Config(), halve_rates_after=50)
    half, _ = optimizer.step(network, gradient, state, optimizer.decayed(0.1, config, state))
    np.testing.assert_allclose(half, whole / 2, rtol=1e-6)
