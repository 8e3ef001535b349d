"""What every agent promises: pure updates, one compilation, targets that move by τ, actions."""

import functools
from dataclasses import FrozenInstanceError, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from midway import functional
from midway.agent import Agent
from midway.agents import beyond, crl, leap, registry, ris, sac, tdm
from midway.errors import ConfigurationError
from midway.types import Subgoal

KEY = jax.random.key(7)
ABILITIES = ("value", "subgoals", "memory", "pretrain", "freezing")


def arrays(tree) -> list[np.ndarray]:
    return [np.asarray(leaf) for leaf in jax.tree.leaves(eqx.filter(tree, eqx.is_array))]


def equal(first, second) -> bool:
    pairs = zip(arrays(first), arrays(second), strict=True)
    return all(np.array_equal(a, b) for a, b in pairs)


def changed(before, after) -> set[str]:
    """Return the fields of the state whose arrays differ."""
    fields = set(vars(before)) - {"config", "spec"}
    return {name for name in fields if not equal(getattr(before, name), getattr(after, name))}


def test_registry_knows_the_agents():
    modules = {"ris": ris, "sac": sac, "tdm": tdm, "leap": leap, "crl": crl}
    for name, module in modules.items():
        agent = registry.get(name)
        assert agent is module.AGENT
        assert isinstance(agent, Agent)
        assert (agent.Config, agent.create, agent.act) == (module.Config, module.create, module.act)
        assert registry.name_of(agent) == registry.name_of(name) == name
        with pytest.raises(FrozenInstanceError):
            agent.networks = ()
    assert set(modules) == set(registry.AGENTS)


def test_abilities_are_fields_that_can_be_asked_for():
    asked = {
        name: {a for a in ABILITIES if getattr(registry.AGENTS[name], a) is not None}
        for name in registry.AGENTS
    }
    assert asked == {
        "ris": {"value", "subgoals", "freezing"},
        "sac": {"value", "freezing"},
        "tdm": {"value", "memory", "freezing"},
        "leap": {"value", "memory", "pretrain", "freezing"},
        "crl": {"value", "freezing"},
    }
    assert leap.AGENT.memory.plan is not None
    assert tdm.AGENT.memory.plan is None


def test_an_agent_of_others_is_found_by_its_module_and_attribute():
    agent = registry.get("another_agent:AGENT")
    assert agent.Config is sac.Config
    assert registry.name_of(agent) == "another_agent:AGENT"
    # One of ours has a name of ours, however it is asked for.
    assert registry.get("midway.agents.ris:AGENT") is ris.AGENT
    assert registry.name_of(registry.get("midway.agents.ris:AGENT")) == "ris"


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("no_such_module_here:AGENT", "No module named 'no_such_module_here'"),
        ("midway.agents.ris:NOTHING", "NOTHING"),
        ("midway.agents.ris:Config", "is a type, not a midway Agent"),
        ("midway.agents.ris:", "agent midway.agents.ris:"),
        (":AGENT", "agent :AGENT"),
        ("", "unknown agent ''"),
    ],
)
def test_an_agent_that_cannot_be_had_is_refused_in_one_line(name, said):
    with pytest.raises(ConfigurationError) as error:
        registry.get(name)
    assert said in str(error.value)
    assert "\n" not in str(error.value)


def test_an_agent_that_no_folder_can_name_is_refused():
    with pytest.raises(ConfigurationError, match="no top-level name of midway"):
        registry.name_of(replace(sac.AGENT, value=None))


def test_registry_refuses_unknown_names_and_says_what_is_allowed():
    with pytest.raises(ConfigurationError, match=r"unknown agent 'dqn'.*ris, sac") as error:
        registry.get("dqn")
    assert "\n" not in str(error.value)


def test_defaults_are_table_1_for_ant_navigation():
    assert vars(ris.Config()) == {
        "hidden": (256, 256),
        "discount": 0.99,
        "target_update_rate": 5e-3,
        "critic_learning_rate": 1e-3,
        "policy_learning_rate": 1e-3,
        "subgoal_learning_rate": 1e-4,
        "encoder_learning_rate": 1e-4,
        "random_shift": 8,
        "image_pooling": 1,
        "kl_weight": 0.1,
        "advantage_temperature": 0.1,
        "num_subgoals": 10,
        "epsilon": 1e-16,
        "precision": "f32",
    } | vars(beyond.SubgoalSettings()) | {"normalise": False}
    assert functional.value_bound(ris.Config().discount) == pytest.approx(100)
    shared = vars(sac.Config()).items() & vars(ris.Config()).items()
    assert len(shared) == len(vars(sac.Config())) - 1  # all but the entropy's learning rate


def test_target_networks_start_equal_to_the_online_ones_with_arrays_of_their_own(case):
    state = case.state
    copies = [(state.critic, state.target_critic)]
    if case.agent is ris.AGENT:
        copies.append((state.policy, state.prior_policy))
    for online, copy in copies:
        assert equal(online, copy)
        pointers = [
            {leaf.unsafe_buffer_pointer() for leaf in jax.tree.leaves(tree)}
            for tree in (online, copy)
        ]
        assert not pointers[0] & pointers[1]


def test_networks_are_parts_of_the_state(case):
    assert set(case.agent.networks) <= set(vars(case.state))
    assert "policy" in case.agent.networks


def test_update_changes_every_part_and_reports_finite_scalars(case):
    state, metrics = case.update(case.state, case.batch, KEY)
    # The encoder of states has no weights, and without a rate no average is kept.
    stateless = {"encoder", "encoder_optimizer", "average_policy"}
    assert changed(case.state, state) >= set(vars(state)) - {"config", "spec"} - stateless
    assert all(np.isfinite(x).all() for x in arrays(state))
    groups = {"critic", "policy"} | ({"subgoal"} if case.agent is ris.AGENT else set())
    assert {name.split("/")[0] for name in metrics} == groups
    for name, value in metrics.items():
        assert value.shape == (), name
        assert value.dtype == jnp.float32, name
        assert np.isfinite(value), name


def test_update_is_pure(case):
    before = [x.copy() for x in arrays((case.state, case.batch))]
    first = case.update(case.state, case.batch, KEY)
    second = case.update(case.state, case.batch, KEY)
    assert equal(first, second)
    after = arrays((case.state, case.batch))
    assert all(np.array_equal(a, b) for a, b in zip(before, after, strict=True))


def test_update_depends_on_its_key(case):
    first, _ = case.update(case.state, case.batch, KEY)
    second, _ = case.update(case.state, case.batch, jax.random.key(8))
    assert {"critic", "policy"} <= changed(first, second)


def test_targets_move_by_exactly_the_target_update_rate(case):
    """A new target is τ times the new network plus 1 - τ times the old target."""
    state, _ = case.update(case.state, case.batch, KEY)
    again, _ = case.update(state, case.batch, jax.random.key(8))
    rate = case.state.config.target_update_rate
    pairs = [("critic", "target_critic")]
    if case.agent is ris.AGENT:
        pairs.append(("policy", "prior_policy"))
    for online, copy in pairs:
        for new, old_copy, new_copy in zip(
            *(arrays(x) for x in (getattr(again, online), getattr(state, copy))),
            arrays(getattr(again, copy)),
            strict=True,
        ):
            expected = rate * new.astype(np.float64) + (1 - rate) * old_copy
            np.testing.assert_allclose(new_copy, expected, rtol=1e-5, atol=1e-8)
            assert not np.array_equal(new_copy, old_copy)


def test_many_updates_compile_once(case):
    traces = 0

    @eqx.filter_jit
    def update(state, batch, key):
        nonlocal traces
        traces += 1
        return case.agent.update(state, batch, key)

    state = case.state
    for i in range(5):
        state, _ = update(state, case.batch, jax.random.key(i))
    assert traces == 1


def test_critic_learns_a_fixed_batch(case):
    """Where every step reaches its goal, every Q is -1."""
    batch = case.batch._replace(terminated=jnp.ones_like(case.batch.terminated))
    state, first = case.update(case.state, batch, KEY)
    for i in range(60):
        state, last = case.update(state, batch, jax.random.key(i))
    assert last["critic/loss"] < 0.05 * first["critic/loss"]
    assert last["critic/target"] == -1
    assert last["critic/q"] == pytest.approx(-1, abs=0.1)


def act(case, key=KEY, explore=False):
    return acting(case)(case.state, case.batch.observation, case.batch.goal, key, explore)


@functools.cache
def compiled(function):
    return eqx.filter_jit(function)


def acting(case):
    return compiled(case.agent.act)


def test_actions_are_the_tanh_of_the_mean_without_exploration(case):
    actions = act(case)
    assert actions.shape == case.batch.action.shape
    mean = case.state.policy(case.batch.observation, case.batch.goal).mean
    np.testing.assert_allclose(actions, np.tanh(mean), rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(actions, act(case, key=jax.random.key(8)))


def test_actions_are_sampled_with_exploration(case):
    """Undoing tanh, mean and std from many draws leaves standard normal noise."""
    draw = acting(case)
    batch = case.batch
    draws = [
        np.asarray(draw(case.state, batch.observation, batch.goal, jax.random.key(i), True))
        for i in range(60)
    ]
    assert np.abs(draws).max() <= 1
    # Whole actions: two of thousands of float32 numbers may meet by chance.
    rows = np.reshape(draws, (-1, np.shape(draws)[-1]))
    assert len(np.unique(rows, axis=0)) == len(rows)
    actions = case.state.policy(batch.observation, batch.goal)
    noise = (np.arctanh(np.asarray(draws, np.float64)) - actions.mean) / np.exp(actions.log_std)
    assert noise.mean() == pytest.approx(0, abs=0.06)
    assert noise.std() == pytest.approx(1, abs=0.06)
    again = draw(case.state, batch.observation, batch.goal, jax.random.key(0), True)
    np.testing.assert_array_equal(again, draws[0])


@pytest.mark.parametrize("explore", [False, True])
def test_actions_stay_in_their_bounds_whatever_the_policy_says(case, explore):
    last = case.state.policy.network.layers[-1]
    state = eqx.tree_at(
        lambda s: s.policy.network.layers[-1].bias, case.state, 100 * jnp.ones_like(last.bias)
    )
    actions = acting(case)(state, case.batch.observation, case.batch.goal, KEY, explore)
    assert abs(actions).max() <= 1
    assert abs(actions).max() > 0.99


def test_actions_come_from_the_policy_alone(case):
    """The flat policy acts: no critic, target network or subgoal policy has a say."""
    broken = {
        name: jax.tree.map(lambda x: jnp.nan * x, getattr(case.state, name))
        for name in case.agent.networks
        if name not in {"encoder", "policy"}
    }
    actions = acting(case)(
        replace(case.state, **broken), case.batch.observation, case.batch.goal, KEY, False
    )
    np.testing.assert_array_equal(actions, act(case))


def test_half_precision_products_leave_everything_else_in_float32(case):
    config = replace(case.state.config, precision="bf16")
    state = case.agent.create(config, case.spec, jax.random.key(0))
    assert equal(state, case.state)  # the same start
    result = eqx.filter_eval_shape(case.agent.update, state, case.batch, KEY)
    types = {leaf.dtype for leaf in jax.tree.leaves(eqx.filter(result, is_array_or_shape))}
    assert types <= {jnp.dtype(jnp.float32), jnp.dtype(jnp.int32)}


def is_array_or_shape(leaf) -> bool:
    return hasattr(leaf, "dtype")


def test_update_refuses_wrong_shapes(case):
    batch = case.batch._replace(goal=case.batch.goal[:-1])
    with pytest.raises(TypeError):
        eqx.filter_eval_shape(case.agent.update, case.state, batch, KEY)


def test_states_in_another_unit_make_the_same_update(state_case):
    case = state_case
    origin, unit = (0.5, -1.0, 2.0, 0.0), 0.125

    def in_metres(code):
        return code * unit + jnp.asarray(origin)

    batch = case.batch._replace(
        observation=in_metres(case.batch.observation),
        next_observation=in_metres(case.batch.next_observation),
        goal=in_metres(case.batch.goal),
        subgoal_candidate=Subgoal(*map(in_metres, case.batch.subgoal_candidate)),
    )
    spec = replace(case.spec, origin=origin, unit=unit)
    state = case.agent.create(case.state.config, spec, jax.random.key(0))
    after, metrics = case.update(state, batch, KEY)
    expected, expected_metrics = case.update(case.state, case.batch, KEY)
    for found, wanted in zip(arrays(after.policy), arrays(expected.policy), strict=True):
        np.testing.assert_allclose(found, wanted, atol=1e-4)
    for key, wanted in expected_metrics.items():
        np.testing.assert_allclose(metrics[key], wanted, rtol=1e-3, atol=1e-4)
