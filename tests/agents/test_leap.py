"""LEAP: the planner on values in closed form, segments and time, both stages, images and pairs."""

import functools
import itertools
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from midway.agents import leap, tdm
from midway.networks.vae import ImageVAE, StateVAE
from midway.training import freeze
from midway.types import Batch, DistanceTask, EnvSpec, Outcome, Subgoal

KEY = jax.random.key(3)
TASK = DistanceTask(((0, 1),), 0.5)
IMAGE = (84, 84, 3)
SPECS = {
    "states": EnvSpec("states", (2,), "float32", (2,), 2, 10, True, None, TASK),
    "pairs": EnvSpec("pairs", (5,), "float32", (2,), 2, 10, False, None, TASK),
    "images": EnvSpec("images", IMAGE, "uint8", IMAGE, 2, 10, True, (4,), TASK),
}
SMALL = leap.Config(
    hidden=(16, 16),
    num_subgoals=3,
    latent_size=2,
    vae_hidden=(16, 16),
    plan_samples=64,
    plan_iterations=4,
)


def arrays(tree) -> list[np.ndarray]:
    return [np.asarray(leaf) for leaf in jax.tree.leaves(eqx.filter(tree, eqx.is_array))]


def equal(first, second) -> bool:
    pairs = zip(arrays(first), arrays(second), strict=True)
    return all(np.array_equal(a, b) for a, b in pairs)


# Made once for each configuration and specification, in one program instead of one an operation.
compiled_create = eqx.filter_jit(leap.create)
pretrain = eqx.filter_jit(leap.pretrain)


@functools.cache
def create(config: leap.Config, spec: EnvSpec) -> leap.State:
    return compiled_create(config, spec, KEY)


def with_plain_latents(state: leap.State) -> leap.State:
    """Return the state with an autoencoder whose latent numbers are the state itself."""
    vae = StateVAE(2, 2, (), key=KEY)
    plain = (jnp.eye(2), jnp.zeros(2))
    vae = eqx.tree_at(lambda v: (v.decoder.layers[0].weight, v.decoder.layers[0].bias), vae, plain)
    return replace(state, vae=vae)


def planner(config: leap.Config) -> leap.State:
    return with_plain_latents(create(config, SPECS["states"]))


def on_features(config):
    """Return LEAP as it acts on images: made for the latents of its frozen autoencoder."""
    pictured = create(config, SPECS["images"])
    encoder = leap.AGENT.freezing.encoder(pictured)
    spec = freeze.encoded_spec(SPECS["images"], encoder)
    fresh = create(config, spec)
    return freeze.keep(leap.AGENT, fresh, pictured), spec, encoder


def made(config, kind):
    """Return LEAP as it acts and learns on a kind of observations, and what it was made for."""
    if kind == "images":
        return on_features(config)[:2]
    return create(config, SPECS[kind]), SPECS[kind]


# --- the planner ----------------------------------------------------------------------------------


def straight(state, start, goal, steps_left):
    """Return minus the distance: of one subgoal the midpoint is best, of three the quarters."""
    return -jnp.linalg.norm(start - goal, axis=-1)


def around_the_wall(state, start, goal, steps_left):
    """Return minus the way around a wall |x| < 0.5 that is open below y = -2; -9 within it."""

    def corner(point):
        return jnp.stack([jnp.clip(point[:, 0], -0.5, 0.5), jnp.full(len(point), -2.0)], axis=1)

    def inside(point):
        return (jnp.abs(point[:, 0]) < 0.5) & (point[:, 1] > -2)

    points = (start, corner(start), corner(goal), goal)
    way = sum(jnp.linalg.norm(a - b, axis=1) for a, b in itertools.pairwise(points))
    same_side = points[1][:, 0] == points[2][:, 0]
    way = jnp.where(same_side, jnp.linalg.norm(start - goal, axis=1), way)
    return jnp.where(inside(start) | inside(goal), -9.0, -way)


def planned(config, start, goal, segment=0, latents=None):
    if latents is None:
        latents = jnp.zeros((config.num_subgoals, 2))
    inputs = jnp.array(start), jnp.array(goal), jnp.array(segment), latents, KEY
    # A function of its own: compiled ones are kept by function, and the value here is patched.
    return np.asarray(jax.jit(lambda *values: leap.plan(*values))(planner(config), *inputs))


THOROUGH = replace(SMALL, plan_samples=600, plan_iterations=30, prior_weight=0.0)


def test_the_midpoint_is_the_best_subgoal_of_a_straight_way(monkeypatch):
    monkeypatch.setattr(tdm, "value", straight)
    plan = planned(replace(THOROUGH, num_subgoals=1), [-1.0, 0.5], [3.0, -1.5])
    np.testing.assert_allclose(plan, [[1, -0.5]], atol=0.03)


def test_several_subgoals_divide_the_way_evenly(monkeypatch):
    monkeypatch.setattr(tdm, "value", straight)
    plan = planned(THOROUGH, [-2.0, -2.0], [2.0, 2.0])
    np.testing.assert_allclose(plan, [[-1, -1], [0, 0], [1, 1]], atol=0.15)


def test_the_best_subgoal_past_a_wall_is_at_its_end(monkeypatch):
    monkeypatch.setattr(tdm, "value", around_the_wall)
    plan = planned(replace(THOROUGH, num_subgoals=1), [-1.5, 0.0], [1.5, 0.0])
    np.testing.assert_allclose(plan, [[0, -2]], atol=0.05)


def test_the_prior_draws_subgoals_to_likely_states(monkeypatch):
    monkeypatch.setattr(tdm, "value", straight)
    config = replace(THOROUGH, num_subgoals=1, prior_weight=0.1)
    free = planned(replace(config, prior_weight=0.0), [2.0, 0.0], [4.0, 0.0])
    drawn = planned(config, [2.0, 0.0], [4.0, 0.0])
    # The smaller leg x - 4 falls by 1 a metre, the log-density rises by 0.1 x: it wins nothing.
    np.testing.assert_allclose(free, drawn, atol=0.05)
    far = planned(replace(config, prior_weight=1.0), [2.0, 0.0], [4.0, 0.0])
    # Now x - 4 - x² / 2 is largest at x = 1.
    np.testing.assert_allclose(far, [[1, 0]], atol=0.05)


def test_score_is_the_worst_segment_to_come_plus_the_prior(monkeypatch):
    monkeypatch.setattr(tdm, "value", straight)
    state = planner(replace(SMALL, prior_weight=0.5))
    latents = jax.random.normal(KEY, (7, 3, 2))
    start, goal = jnp.array([-3.0, 0.0]), jnp.array([3.0, 1.0])
    for segment in range(4):
        score = leap.score(state, latents, start, goal, jnp.array(segment))
        for row in range(7):
            to_come = np.asarray(latents[row, segment:])
            points = np.stack([start, *to_come, goal])
            worst = np.linalg.norm(np.diff(points, axis=0), axis=1).max()
            log_density = -(to_come**2).sum() / 2 - to_come.size * np.log(2 * np.pi) / 2
            assert score[row] == pytest.approx(-worst + 0.5 * log_density, rel=1e-4)


def test_replanning_leaves_what_is_over_out(monkeypatch):
    monkeypatch.setattr(tdm, "value", straight)
    before = jnp.array([[5.0, 5.0], [1.0, 1.0], [1.0, 1.0]])
    plan = planned(THOROUGH, [-2.0, 0.0], [2.0, 0.0], segment=2, latents=before)
    np.testing.assert_allclose(plan[2], [0, 0], atol=0.05)


# --- segments and time ----------------------------------------------------------------------------


def test_segments_share_the_episode():
    spec = replace(SPECS["states"], max_episode_steps=600)
    ant = leap.Config()
    assert ant.num_subgoals == 11
    assert leap.segment_steps(ant, spec) == 50
    assert leap.segment_steps(replace(ant, max_steps_left=100), spec) == 50
    assert leap.segment_steps(replace(ant, max_steps_left=24), spec) == 25  # at most the horizon
    push = leap.Config(num_subgoals=3, max_steps_left=25)
    assert leap.segment_steps(push, replace(spec, max_episode_steps=100)) == 25


def follow(state, memory, steps, monkeypatch):
    """Return for each step the plans made so far, the aim, and the steps left, of one episode."""
    counted = []
    monkeypatch.setattr(leap, "plan", lambda state, o, g, segment, latents, key: latents + 1)
    seen = []
    policy = type(state.policy).__call__
    monkeypatch.setattr(
        type(state.policy),
        "__call__",
        lambda self, *inputs: seen.append(inputs) or policy(self, *inputs),
    )
    observation, goal = jnp.zeros((len(memory.elapsed), 2)), jnp.full((len(memory.elapsed), 2), 9.0)
    for _ in range(steps):
        seen.clear()
        _, memory = leap.act_on(state, memory, observation, goal, KEY, False)
        _, aim, steps_left = next(inputs for inputs in seen if len(inputs) == 3)
        counted.append((memory.latents[:, 0, 0], aim[:, 0], steps_left[:, 0]))
    plans, aims, left = (np.asarray(jnp.stack(x)) for x in zip(*counted, strict=True))
    return plans, aims, left, memory


def test_a_plan_is_made_at_the_start_of_every_segment_but_the_last(monkeypatch):
    state = planner(SMALL)
    memory = leap.begin(SMALL, SPECS["states"], 1)
    plans, aims, left, memory = follow(state, memory, 10, monkeypatch)
    assert plans[:, 0].tolist() == [1, 1, 1, 2, 2, 2, 3, 3, 3, 3]
    # Subgoals are the plan's numbers here; the last segment aims at the goal itself.
    assert aims[:, 0].tolist() == [1, 1, 1, 2, 2, 2, 3, 3, 3, 9]
    assert left[:, 0].tolist() == [2, 1, 0, 2, 1, 0, 2, 1, 0, 2]
    assert memory.elapsed.tolist() == [10]


def test_episodes_at_different_times_plan_on_their_own(monkeypatch):
    state = planner(SMALL)
    memory = leap.begin(SMALL, SPECS["states"], 3)._replace(elapsed=jnp.array([0, 2, 40]))
    plans, aims, left, _ = follow(state, memory, 3, monkeypatch)
    assert plans.T.tolist() == [[1, 1, 1], [0, 1, 1], [0, 0, 0]]
    assert aims.T.tolist() == [[1, 1, 1], [0, 1, 1], [9, 9, 9]]
    assert left.T.tolist() == [[2, 1, 0], [0, 2, 1], [1, 0, 2]]


def test_shorter_ways_have_their_share_of_the_subgoals():
    ant = leap.Config()
    # Of case 10 of the S maze, 4.5 of 30.2 m: 11 * 0.149 = 1.6; of half the way: 5.5.
    ways = np.array([0.0, 4.5 / 30.2, 0.5, 0.97, 1.0])
    memory = leap.adapt(ant, leap.begin(ant, SPECS["states"], 5), ways)
    assert (11 - memory.first).tolist() == [1, 2, 6, 11, 11]
    fixed = replace(ant, adapt_subgoals=False)
    assert leap.adapt(fixed, leap.begin(fixed, SPECS["states"], 5), ways).first.tolist() == [0] * 5


def test_an_episode_with_fewer_subgoals_aims_at_its_goal_earlier(monkeypatch):
    state = planner(SMALL)
    memory = leap.begin(SMALL, SPECS["states"], 2)
    memory = leap.adapt(SMALL, memory, np.array([0.3, 0.6]))
    plans, aims, left, memory = follow(state, memory, 8, monkeypatch)
    assert plans.T.tolist() == [[1] * 8, [1, 1, 1, 2, 2, 2, 2, 2]]
    assert aims.T.tolist() == [[1, 1, 1, 9, 9, 9, 9, 9], [1, 1, 1, 2, 2, 2, 9, 9]]
    assert left.T.tolist() == 2 * [[2, 1, 0, 2, 1, 0, 2, 1]]
    # What is drawn of a plan holds no subgoal that was left out.
    memory = memory._replace(latents=jnp.arange(12.0).reshape(2, 3, 2))
    shown = leap.AGENT.memory.plan(state, memory).subgoals[:, :, 0]
    assert shown.tolist() == [[4, 4, 4], [8, 8, 10]]


def test_the_subgoal_that_is_due_is_the_one_that_the_last_action_aimed_at(monkeypatch):
    state = planner(SMALL)
    memory = leap.adapt(SMALL, leap.begin(SMALL, SPECS["states"], 2), np.array([1.0, 0.6]))
    due = []
    for _ in range(10):
        *_, memory = follow(state, memory, 1, monkeypatch)
        due.append(leap.AGENT.memory.plan(state, memory).due)
    # In the last segment, which aims at the goal, it is the last of them.
    assert np.transpose(due).tolist() == [[0] * 3 + [1] * 3 + [2] * 4, [1] * 3 + [2] * 7]


def test_exploration_is_the_tdm_without_a_plan():
    state = create(SMALL, SPECS["states"])
    memory = leap.begin(SMALL, SPECS["states"], 4)
    start, goal = jnp.ones((4, 2)), jnp.zeros((4, 2))
    actions, after = leap.act_on(state, memory, start, goal, KEY, True)
    expected, explorer = tdm.act_on(state, memory.explorer, start, goal, KEY, True)
    np.testing.assert_array_equal(actions, expected)
    assert equal(after, memory._replace(explorer=explorer))


@pytest.mark.parametrize("kind", SPECS)
def test_actions_are_in_bounds_and_repeatable(kind):
    config = replace(SMALL, plan_samples=8, plan_iterations=2)
    state, spec = made(config, kind)
    observation = jnp.ones((2, *spec.observation_shape), spec.observation_dtype)
    goal = jnp.zeros((2, *spec.goal_shape), spec.observation_dtype)
    act = eqx.filter_jit(leap.act)
    for explore in (False, True):
        actions = act(state, observation, goal, KEY, explore)
        assert actions.shape == (2, 2)
        assert jnp.abs(actions).max() <= 1
        np.testing.assert_array_equal(actions, act(state, observation, goal, KEY, explore))


# --- subgoals -------------------------------------------------------------------------------------


def test_subgoals_have_both_roles():
    state = create(SMALL, SPECS["pairs"])
    latent = jax.random.normal(KEY, (4, 2))
    subgoal = leap.subgoals_of(state, latent)
    both = state.vae.decode(latent)
    np.testing.assert_array_equal(subgoal.observation, both[:, :5])
    np.testing.assert_array_equal(subgoal.achieved_goal, both[:, 5:])


def test_image_subgoals_are_decoded_and_encoded_again():
    state, _ = made(replace(SMALL, latent_size=6), "images")
    assert isinstance(state.vae, ImageVAE)
    assert state.policy.layers[0].weight.shape[0] == 6 + 6 + 1
    latent = jax.random.normal(KEY, (3, 6))
    subgoal = leap.subgoals_of(state, latent)
    expected = state.vae.encode(state.vae.decode(latent)).mean
    np.testing.assert_allclose(subgoal.observation, expected, rtol=1e-5)
    assert subgoal.observation is subgoal.achieved_goal


# --- learning -------------------------------------------------------------------------------------


def draw_batch(spec: EnvSpec, size: int) -> Batch:
    rng = np.random.default_rng(0)

    def draw(shape):
        if spec.observation_dtype == "uint8":
            return jnp.asarray(rng.integers(0, 256, (size, *shape)), jnp.uint8)
        return jnp.asarray(rng.normal(size=(size, *shape)), jnp.float32)

    observation, following = draw(spec.observation_shape), draw(spec.observation_shape)
    goal = draw(spec.goal_shape)
    size_of_truth = (spec.state_shape or spec.goal_shape)[0]
    truth = [jnp.asarray(rng.normal(size=(size, size_of_truth)), jnp.float32) for _ in range(2)]
    return Batch(
        observation=observation,
        action=jnp.asarray(rng.uniform(-1, 1, (size, 2)), jnp.float32),
        reward=-jnp.ones(size),
        terminated=jnp.zeros(size, bool),
        next_observation=following,
        goal=goal,
        subgoal_candidate=Subgoal(observation, goal),
        outcome=None if spec.goal_is_observation and not spec.state_shape else Outcome(*truth),
    )


@pytest.mark.parametrize("kind", SPECS)
def test_updates_are_those_of_the_tdm_and_leave_the_autoencoder(kind):
    state, spec = made(SMALL, kind)
    batch = draw_batch(spec, 8)
    copies = arrays((state, batch))
    after, metrics = eqx.filter_jit(leap.AGENT.update)(state, batch, KEY)
    assert all(np.array_equal(a, b) for a, b in zip(copies, arrays((state, batch)), strict=True))
    assert isinstance(after, leap.State)
    assert equal(after.vae, state.vae)
    assert not equal(after.critic, state.critic)
    assert {name.split("/")[0] for name in metrics} == {"critic", "policy"}
    if kind == "states":
        expected, _ = eqx.filter_jit(tdm.update)(state, batch, KEY)
        assert equal(after, expected)
    if kind == "images":
        assert state.critic[0].layers[-1].weight.shape[1] == 4  # rewards are of the true state


def test_pretraining_teaches_the_autoencoder_alone():
    spec = SPECS["states"]
    config = replace(SMALL, vae_kl_weight=1e-3, vae_learning_rate=3e-3, vae_updates=150)
    state = create(config, spec)
    positions = jax.random.uniform(KEY, (2_000, 2), minval=-6.0, maxval=6.0)
    states = Subgoal(positions, positions)
    distances, after = [], state
    for number in range(8):
        after, metrics = pretrain(after, states, jax.random.key(number))
        distances.append(float(metrics["vae/held_out_distance"]))
    assert distances[-1] < 0.4 < distances[0]
    expected = metrics["vae/error"] + 1e-3 * metrics["vae/kl"]
    np.testing.assert_allclose(metrics["vae/loss"], expected, rtol=1e-4)
    others = set(vars(state)) - {"vae", "vae_optimizer", "config", "spec", "encoder"}
    assert all(equal(getattr(state, name), getattr(after, name)) for name in others)
    np.testing.assert_allclose(after.vae.center, positions[:1_800].mean(0), rtol=1e-5)


def test_pretraining_reads_both_roles_of_a_state():
    spec = SPECS["pairs"]
    state = create(replace(SMALL, vae_updates=2), spec)
    states = Subgoal(jax.random.normal(KEY, (100, 5)), jax.random.normal(KEY, (100, 2)))
    after, _ = pretrain(state, states, KEY)
    assert after.vae.center.shape == (7,)


def test_settings_of_pretraining():
    settings = leap.pretrain_settings(leap.Config(vae_source="runs/other"))
    assert settings.networks == ("vae",)
    assert (settings.states, settings.rounds, settings.source) == (50_000, 2_500, "runs/other")


def test_the_value_of_leap_is_that_of_its_tdm_at_the_whole_horizon():
    state = create(SMALL, SPECS["pairs"])
    observation, goal = jax.random.normal(KEY, (6, 5)), jax.random.normal(KEY, (6, 2))
    found = leap.AGENT.value.estimate(state, observation, goal)
    whole = jnp.full((6, 1), float(SMALL.max_steps_left))
    np.testing.assert_allclose(found, tdm.value(state, observation, goal, whole), rtol=1e-6)


def test_reconstructions_are_what_the_autoencoder_keeps_of_both_roles():
    state = create(SMALL, SPECS["pairs"])
    states = Subgoal(jax.random.normal(KEY, (9, 5)), jax.random.normal(KEY, (9, 2)))
    both = jnp.concatenate(states, axis=1)
    expected = state.vae.decode(state.vae.encode(both).mean)
    np.testing.assert_array_equal(leap.AGENT.pretrain.reconstruct(state, states), expected)


def test_plans_are_told_as_achieved_goals_in_the_units_of_the_environment():
    spec = replace(SPECS["pairs"], origin=(1.0, 2.0, 0.0, 0.0, 0.0, 3.0, 4.0), unit=0.5)
    spec = replace(spec, observation_shape=(7,), goal_shape=(7,), goal_is_observation=True)
    state = create(SMALL, spec)
    memory = leap.begin(SMALL, spec, 2)._replace(latents=jax.random.normal(KEY, (2, 3, 2)))
    plans = leap.AGENT.memory.plan(state, memory).subgoals
    assert plans.shape == (2, 3, 7)
    np.testing.assert_allclose(plans, state.vae.decode(memory.latents), rtol=1e-5, atol=1e-5)


def test_episodes_that_rest_make_no_plan():
    memory = leap.begin(SMALL, SPECS["states"], 3)
    rested = leap.AGENT.memory.rest(memory, jnp.array([True, False, True]))
    state = planner(SMALL)
    start = jnp.ones((3, 2))
    latents = leap.plan_where_due(state, start, start, rested, KEY)
    np.testing.assert_array_equal(latents[::2], 0)
    assert jnp.abs(latents[1]).max() > 0


def test_leap_freezes_its_autoencoder_before_the_first_update():
    config = replace(SMALL, latent_size=6)
    state, spec, encoder = on_features(config)
    assert leap.AGENT.freezing.at_start
    assert not tdm.AGENT.freezing.at_start
    assert isinstance(state.vae, ImageVAE)
    assert (spec.observation_shape, spec.goal_shape, spec.image_shape) == ((6,), (6,), IMAGE)
    images = draw_batch(SPECS["images"], 3).observation
    np.testing.assert_array_equal(encoder(images), state.vae.encode(images).mean)


def test_defaults_are_those_of_the_ant():
    config = leap.Config()
    assert (config.num_subgoals, config.latent_size, config.vae_hidden) == (11, 8, (64, 128, 64))
    assert (config.plan_samples, config.plan_iterations) == (10_000, 50)
    assert (config.plan_elites, config.plan_std, config.prior_weight) == ((0.25, 0.01), 1.5, 0.1)
    assert (config.vae_batch_size, config.vae_updates, config.vae_rounds) == (128, 100, 2_500)
