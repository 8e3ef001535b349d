"""What the camera sees: the state it belongs to, readable, and quick to draw."""

import subprocess
import sys
import threading

import gymnasium
import numpy as np
import pytest

from drawing_here import needs_renderer
from midway.envs import rendering
from midway.envs.push_scene import HAND_BOX, IMAGE_SIZE, PUCK_BOX, TASKS, push_model
from midway.envs.registry import make_vec
from midway.envs.rendering import BACKENDS, Renderer, backend, draw
from midway.envs.single import SingleGoalEnv
from midway.errors import ConfigurationError


def far_from(states):
    """Return a possible goal that is far from each state."""
    return np.where(states[:, :1] > 0, (-0.2, 0.5, -0.1, 0.6), (0.2, 0.7, 0.1, 0.6))


def pixels_that_differ(images, others):
    """Return how many pixels of each image differ by more than 8 of 255 in any colour."""
    differences = np.abs(images.astype(int) - others.astype(int)).max(axis=-1)
    return (differences > 8).sum(axis=(1, 2))


def is_hand(images):
    red, green, blue = np.moveaxis(images.astype(int), -1, 0)
    return (green > 100) & (red < 100) & (blue < 100)


def is_puck(images):
    red, green, blue = np.moveaxis(images.astype(int), -1, 0)
    return (blue > 60) & (blue > red) & (blue > green + 40)


def centres(masks):
    """Return the mean column and row of each mask, (n, 2)."""
    counts = masks.sum(axis=(1, 2))
    places = np.arange(IMAGE_SIZE)
    columns = (masks * places).sum(axis=(1, 2)) / counts
    rows = (masks * places[:, None]).sum(axis=(1, 2)) / counts
    return np.stack([columns, rows], axis=1)


def projected(points):
    """Return column and row of points (n, 3) of the world by the geometry of the camera."""
    model = push_model()
    x_axis, y_axis, z_axis = model.cam_mat0[0].reshape(3, 3).T
    offsets = points - model.cam_pos0[0]
    focal = IMAGE_SIZE / 2 / np.tan(np.radians(model.cam_fovy[0]) / 2)
    scale = focal / -(offsets @ z_axis)
    middle = (IMAGE_SIZE - 1) / 2
    return np.stack([middle + scale * (offsets @ x_axis), middle - scale * (offsets @ y_axis)], 1)


@needs_renderer
def test_images_are_one_block_of_bytes():
    env = make_vec("push", 3)
    for observations in (env.reset(seed=0)[0], env.step(np.zeros((3, 2)))[0]):
        for key in ("observation", "achieved_goal", "desired_goal"):
            images = observations[key]
            assert (images.shape, images.dtype) == ((3, 84, 84, 3), np.uint8)
            assert images.flags.c_contiguous


@needs_renderer
def test_states_are_those_of_the_version_without_images():
    images, states = make_vec("push", 3), make_vec("push-state", 3)
    rng = np.random.default_rng(0)
    seen, known = images.reset(seed=5)[0], states.reset(seed=5)[0]
    for _ in range(5):
        np.testing.assert_array_equal(seen["achieved_state"], known["achieved_goal"])
        np.testing.assert_array_equal(seen["desired_state"], known["desired_goal"])
        actions = rng.uniform(-1, 1, (3, 2))
        seen, known = images.step(actions)[0], states.step(actions)[0]


@needs_renderer
def test_image_equals_a_fresh_render_of_the_same_state():
    env = make_vec("push", 4, task="near")
    rng = np.random.default_rng(0)
    seen = [env.reset(seed=0)[0]]
    for _ in range(8):
        # A renderer that is made in between takes the thread's drawing context.
        fresh = Renderer(push_model()).draw(env.batch.qpos)
        np.testing.assert_array_equal(seen[-1]["observation"], fresh)
        env._ended[:] = False
        seen.append(env.step(rng.uniform(-1, 1, (4, 2)))[0])
    assert (pixels_that_differ(seen[0]["observation"], seen[-1]["observation"]) > 10).all()


@needs_renderer
def test_images_follow_a_loaded_state():
    env, other = make_vec("push", 2), make_vec("push", 2)
    env.reset(seed=0)
    expected = env.step(np.ones((2, 2)))[0]
    other.reset(seed=1)
    other.load_state_dict(env.state_dict())
    mask = np.array([True, False])
    loaded = other.reset(options={"reset_mask": mask})[0]
    for key in expected:
        np.testing.assert_array_equal(loaded[key][1], expected[key][1], err_msg=key)


@needs_renderer
def test_goal_image_is_what_is_seen_when_the_state_is_that_of_the_goal():
    env = make_vec("push", 16)
    wanted = env.reset(seed=0)[0]
    goals = wanted["desired_state"].astype(np.float64)
    options = {"start": goals, "goal": far_from(goals)}
    reached = env.reset(options=options)[0]
    assert (pixels_that_differ(reached["observation"], wanted["desired_goal"]) <= 2).all()
    assert (pixels_that_differ(reached["observation"], wanted["observation"]) > 200).all()


@needs_renderer
def test_goal_image_is_what_is_seen_when_the_hand_has_gone_there():
    """At most 20 of 7056 pixels differ: the posture of the arm is that of the goal image."""
    hands = np.array([(x, y) for x in (-0.2, 0.0, 0.2) for y in (0.5, 0.6, 0.7)])
    pucks = np.where(hands[:, :1] > 0, (-0.1, 0.6), (0.1, 0.6))
    goals = np.concatenate([hands, pucks], axis=1)
    starts = np.insert(pucks, 0, [[0.0], [0.6]], axis=1)
    env = make_vec("push", 9)
    wanted = env.reset(options={"start": starts, "goal": goals})[0]
    for _ in range(14):
        env._ended[:] = False
        ahead = hands - env._targets
        actions = ahead / np.maximum(0.02, np.abs(ahead).max(axis=1, keepdims=True))
        seen = env.step(actions)[0]
    np.testing.assert_allclose(seen["achieved_state"], goals, atol=1e-3)
    assert (pixels_that_differ(seen["observation"], wanted["desired_goal"]) <= 20).all()


def readable_states():
    hands = [(x, y) for x in (-0.2, -0.1, 0.0, 0.1, 0.2) for y in (0.5, 0.55, 0.6, 0.65, 0.7)]
    (low_x, low_y), (high_x, high_y) = PUCK_BOX.low, PUCK_BOX.high
    pucks = [(x, y) for x in np.linspace(low_x, high_x, 9) for y in np.linspace(low_y, high_y, 5)]
    states = np.array([(*hand, *puck) for hand in hands for puck in pucks])
    return states[np.linalg.norm(states[:, 2:] - states[:, :2], axis=1) > 0.055]


@needs_renderer
def test_hand_and_puck_are_seen_everywhere():
    states = readable_states()
    images = make_vec("push").images(states)
    hands, pucks = is_hand(images), is_puck(images)
    assert hands.sum(axis=(1, 2)).min() >= 30
    assert pucks.sum(axis=(1, 2)).min() >= 40
    table = np.abs(images.astype(int) - (134, 134, 112)).max(axis=-1) < 25
    assert (table.mean(axis=(1, 2)) > 0.3).all()


@needs_renderer
def test_hand_and_puck_are_seen_where_they_are():
    """World x points left in the image and y down, by the geometry of the camera."""
    states = readable_states()
    images = make_vec("push").images(states)
    pucks = projected(np.insert(states[:, 2:], 2, 0.017, axis=1))
    hands = projected(np.insert(states[:, :2], 2, 0.06, axis=1))
    # The arm hides a part of some pucks, which moves the middle of what is left.
    errors = np.linalg.norm(centres(is_puck(images)) - pucks, axis=1)
    assert np.median(errors) < 0.7
    assert errors.max() < 5
    assert np.linalg.norm(centres(is_hand(images)) - hands, axis=1).max() < 3
    for columns_and_rows in (hands, pucks):
        assert ((columns_and_rows > 8) & (columns_and_rows < IMAGE_SIZE - 8)).all()
    left, right = projected(np.array(((0.2, 0.6, 0.0), (-0.2, 0.6, 0.0))))
    far, near = projected(np.array(((0.0, 0.5, 0.0), (0.0, 0.7, 0.0))))
    assert left[0] < right[0]
    assert far[1] < near[1]


@needs_renderer
def test_the_renderer_of_a_thread_draws_all_its_pictures(monkeypatch):
    env = make_vec("push", 1, num_threads=1)
    env.reset(seed=0)
    monkeypatch.setattr(rendering, "Renderer", None)
    draw(env.model, env.poses(readable_states()[:3]))
    for task in TASKS:
        env.reset(options={"task": task})


@needs_renderer
def test_any_thread_draws_the_same():
    env = make_vec("push", 2)
    expected = env.reset(seed=0)[0]["observation"]
    drawn = []

    def work():
        drawn.append(draw(push_model(), env.batch.qpos))

    for _ in range(2):
        thread = threading.Thread(target=work)
        thread.start()
        thread.join()
    for images in (*drawn, draw(push_model(), env.batch.qpos)):
        np.testing.assert_array_equal(images, expected)


@needs_renderer
def test_backend_is_known_by_its_name():
    assert backend() in BACKENDS


FORKED = """
import os, sys, numpy as np
from midway.envs.registry import make_vec
env = make_vec("push", 1)
before = env.reset(seed=0)[0]["observation"]
child = os.fork()
if child == 0:
    again = make_vec("push", 1).reset(seed=0)[0]["observation"]
    os._exit(0 if np.array_equal(before, again) else 1)
sys.exit(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]))
"""


@needs_renderer
def test_a_forked_child_draws_the_same():
    subprocess.run([sys.executable, "-c", FORKED], check=True)


WITHOUT_RENDERER = """
from midway.envs import rendering
from midway.envs.registry import make_vec
from midway.errors import ConfigurationError
rendering.BACKENDS = ("none", "nothing")
try:
    make_vec("push")
except ConfigurationError as error:
    assert "libegl1 libgl1-mesa-dri (or libosmesa6)" in str(error), error
    assert "none: No module" in str(error) and "nothing: No module" in str(error), error
    assert chr(10) not in str(error), error
else:
    raise AssertionError("no error")
assert make_vec("push-state").reset(seed=0)[0]["observation"].shape == (1, 4)
"""


def test_without_a_renderer_images_fail_clearly_and_states_work():
    subprocess.run([sys.executable, "-W", "error", "-c", WITHOUT_RENDERER], check=True)


def test_the_image_shows_all_of_the_workspace():
    for box in (HAND_BOX, PUCK_BOX):
        corners = [
            (x, y, 0.0) for x in (box.low[0], box.high[0]) for y in (box.low[1], box.high[1])
        ]
        seen = projected(np.array(corners))
        assert ((seen > 8) & (seen < IMAGE_SIZE - 8)).all()


@needs_renderer
def test_rewards_of_images_are_refused_and_of_their_states_given():
    env = SingleGoalEnv("push")
    observation, _ = env.reset(seed=0)
    with pytest.raises(ConfigurationError, match="give achieved_state and desired_state"):
        env.compute_reward(observation["achieved_goal"], observation["desired_goal"], {})
    states = observation["desired_state"], observation["desired_state"]
    assert env.compute_terminated(*states, {})


@needs_renderer
@pytest.mark.parametrize("name", ["PointMaze-Pi", "PushState"])
def test_registered_environments_draw_themselves(name):
    env = gymnasium.make(f"midway/{name}-v0", render_mode="rgb_array")
    env.reset(seed=0)
    picture = env.render()
    assert picture.dtype == np.uint8
    assert picture.std() > 10
    for _ in range(4):
        env.step(np.array([1.0, 0.0], np.float32))
    assert (env.render() != picture).any()
    assert gymnasium.make(f"midway/{name}-v0").unwrapped.render() is None


def test_other_ways_to_draw_are_refused(monkeypatch):
    with pytest.raises(ConfigurationError, match="render_mode 'ansi': must be human, rgb_array"):
        SingleGoalEnv("point-u", render_mode="ansi")
    for name in ("DISPLAY", "WAYLAND_DISPLAY"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(ConfigurationError, match="needs a display, and there is none here"):
        SingleGoalEnv("point-u", render_mode="human")
