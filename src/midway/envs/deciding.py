"""What counts as success in an environment that is not midway's, decided once and on evidence.

In this order: what the user gave; the environment's ``compute_terminated``; ``_is_success``, which
its info comes from; ``compute_reward`` where it has two values; a threshold on the distance that
explains all that its info said. A candidate must be true at every goal, false somewhere, depend on
the goals alone, and agree with the environment's info at every moment that was seen. Where none
does, the environment is refused.
"""

import dataclasses
import itertools
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np

from midway.envs.probes import Probes
from midway.envs.reading import Array
from midway.envs.sources import Source
from midway.envs.success import (
    AskedRule,
    DistanceRule,
    FunctionRule,
    How,
    Rule,
    function_of,
    method_of,
    reference_of,
)
from midway.errors import ConfigurationError
from midway.types import Function, OwnEnv

Question: TypeAlias = Callable[[Array, Array], Array]
"""``(achieved, desired) -> reached`` over a batch."""

METHODS = ("compute_terminated", "_is_success", "compute_reward")
REMEDY = "give --success-distance D or --success-function MODULE:FUNCTION"


@dataclass(frozen=True)
class Evidence:
    """All that a rule is decided on.

    Attributes:
        name: Name of the environment.
        source: What makes it.
        judge: One environment that has just been reset, which a rule will ask later.
        env: Another one, which is somewhere in an episode.
        goal_shape: Shape of a goal as the environment knows it.
        probes: Random episodes.
        more: Returns longer ones, of another seed.
    """

    name: str
    source: Source
    judge: OwnEnv
    env: OwnEnv
    goal_shape: tuple[int, ...]
    probes: Probes
    more: Callable[[int], Probes]


class _UnfitError(Exception):
    """A candidate is no rule of success; the text says why."""


def given(
    evidence: Evidence,
    success_distance: float | None,
    success_function: str | Function | None,
) -> Rule | None:
    """Return the rule that the user gave, nothing where there is none.

    Raises:
        ConfigurationError: It cannot be used.
    """
    if success_distance is not None and success_function is not None:
        raise ConfigurationError("give success_distance or success_function, not both")
    if success_function is not None:
        return _given_function(evidence, success_function)
    if success_distance is None:
        return None
    if not 0 < success_distance < np.inf:
        raise ConfigurationError(f"success_distance {success_distance}: must be positive")
    coordinates = tuple(range(evidence.probes.desired.shape[1]))
    return DistanceRule((coordinates,), float(success_distance), because="given")


def own(evidence: Evidence) -> Rule:
    """Return the environment's own rule of success.

    Raises:
        ConfigurationError: It has none that could be found; its text says what to give.
    """
    reasons: list[str] = []
    for method in METHODS:
        if method_of(evidence.judge, method) is None:
            continue
        try:
            return _as_distance(evidence, _asked(evidence, method))
        except _UnfitError as reason:
            reasons.append(f"{method} {reason}")
    try:
        return _explained(evidence)
    except _UnfitError as reason:
        reasons.append(str(reason))
    raise ConfigurationError(
        f"{evidence.name} does not say when a goal is reached: {'; '.join(reasons)}; random "
        f"episodes came within {_nearest(evidence.probes):.3g} of the goal: {REMEDY}"
    )


def _asked(evidence: Evidence, method: str) -> AskedRule:
    """Return a method of the environment as a rule.

    Raises:
        _UnfitError: It is none.
    """
    rule = AskedRule(evidence.source, method, None, False, evidence.goal_shape)
    achieved, desired, at_goal = _pairs(evidence.probes)
    answers = _answers(evidence, rule, achieved, desired)
    if method == "compute_reward":
        rule = dataclasses.replace(rule, above=_threshold(answers, at_goal))
    reached = answers > rule.threshold
    if not reached[at_goal].all():
        raise _UnfitError("is not true at the goal itself")
    if reached.all():
        raise _UnfitError("is true everywhere")
    _check_word(evidence.probes, reached[: len(evidence.probes.word)])
    batched = _answers_batches(evidence.judge, rule, achieved, desired, answers)
    return dataclasses.replace(rule, batched=batched)


def _pairs(probes: Probes) -> tuple[Array, Array, Array]:
    """Return pairs of goals to ask about, and which of them are at the goal.

    The moments as they were; states with the goals of others; points on the way to the goal; and
    the goals themselves.
    """
    achieved, desired = probes.achieved, probes.desired
    goals = np.unique(desired, axis=0)
    few = achieved[:: max(len(achieved) // 20, 1)]
    crossed = [np.repeat(few, len(goals[:10]), 0), np.tile(goals[:10], (len(few), 1))]
    shares = np.tile(np.geomspace(1e-4, 1, 16), len(few))[:, None]
    ends = np.repeat(few, 16, 0), np.repeat(desired[:: max(len(desired) // 20, 1)], 16, 0)
    between = ends[1] + shares * (ends[0] - ends[1])
    starts = np.concatenate([achieved, crossed[0], between, goals])
    finishes = np.concatenate([desired, crossed[1], ends[1], goals])
    return starts, finishes, np.arange(len(starts)) >= len(starts) - len(goals)


def _answers(evidence: Evidence, rule: AskedRule, achieved: Array, desired: Array) -> Array:
    """Return a method's answers to each pair of goals.

    Raises:
        _UnfitError: It cannot be asked, answers no number, or depends on more than the goals.
    """
    try:
        with np.errstate(all="ignore"):
            answers = rule.values(evidence.judge, achieved, desired)
            again = rule.values(evidence.env, achieved, desired)
    except Exception as error:
        text = " ".join(str(error).split())
        raise _UnfitError(
            f"cannot be asked about two goals ({type(error).__name__}: {text})"
        ) from error
    if np.isnan(answers).any():
        raise _UnfitError("is NaN")
    if not np.array_equal(answers, again):
        raise _UnfitError("depends on more than the two goals")
    return answers


def _threshold(rewards: Array, at_goal: Array) -> float:
    """Return what a reward with two values is above at the goal, and only there.

    Raises:
        _UnfitError: The reward does not have two values, or the wrong ones.
    """
    values = np.unique(np.round(rewards, 9)) + 0.0  # not -0
    if len(values) == 1:
        raise _UnfitError(f"is always {values[0]:.4g}")
    best = np.round(rewards[at_goal], 9) + 0.0
    if len(values) > 2:
        raise _UnfitError(
            f"is dense ({best.max():.4g} at the goal, down to {values[0]:.4g} elsewhere)"
        )
    if not (best == values[1]).all():
        raise _UnfitError(
            f"has two values, {values[0]:.4g} and {values[1]:.4g}, but is not always "
            f"{values[1]:.4g} at the goal"
        )
    return float(values.mean())


def _check_word(probes: Probes, reached: Array) -> None:
    """Check that a rule says what info says.

    Raises:
        _UnfitError: It does not.
    """
    wrong = (probes.word >= 0) & (probes.word != reached)
    if wrong.any():
        raise _UnfitError(
            f"is {bool(reached[wrong][0])} where info[{probes.key!r}] is "
            f"{bool(probes.word[wrong][0])} (in {wrong.sum()} of {len(wrong)} moments)"
        )


def _answers_batches(
    judge: OwnEnv, rule: AskedRule, achieved: Array, desired: Array, answers: Array
) -> bool:
    """Return whether a method answers for a batch as it does for the pairs, at several sizes."""
    batched = dataclasses.replace(rule, batched=True)
    goal_size = achieved.shape[1]
    for size in (len(achieved), 1, 2, goal_size):
        # The last pairs are at the goal, the first are not: both kinds are in every batch.
        part = np.r_[0 : size - size // 2, len(achieved) - size // 2 : len(achieved)]
        try:
            with np.errstate(all="ignore"):
                same = batched.answers(judge, achieved[part], desired[part])
        except Exception:
            return False
        if not np.array_equal(same, answers[part] > batched.threshold):
            return False
    return True


def _as_distance(evidence: Evidence, rule: AskedRule) -> Rule:
    """Return a rule that is a threshold on a distance as one, and others as they are."""
    achieved, desired, _ = _pairs(evidence.probes)

    def question(achieved: Array, desired: Array) -> Array:
        return rule.answers(evidence.judge, achieved, desired)

    try:
        with np.errstate(all="ignore"), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            found = _ball(question, np.unique(desired, axis=0)[:4])
            if found is None:
                return rule
            same = found(achieved, desired)[1]
            if not np.array_equal(same, question(achieved, desired)):
                return rule
    except Exception:  # it does not answer to goals that it has never shown
        return rule
    return dataclasses.replace(found, because=f"as its {rule.method} says, checked")


def _ball(question: Question, goals: Array) -> DistanceRule | None:
    """Return the threshold on the Euclidean distance that a question is, if it is one.

    The threshold is found by bisection along every coordinate from every goal, in both directions;
    then points just inside and just outside, in random directions, must all be as it says.
    """
    size = goals.shape[1]
    arms = np.concatenate([np.eye(size), -np.eye(size)])
    centers, arms = np.repeat(goals, 2 * size, 0), np.tile(arms, (len(goals), 1))
    far = 1e6
    free = question(centers + far * arms, centers).reshape(-1, size)
    if not (free == free[0]).all() or free.all():
        return None
    used = np.flatnonzero(~free[0])
    along = np.isin(np.argmax(np.abs(arms), 1), used)
    radius = _bisected(question, centers[along], arms[along], far)
    if radius is None:
        return None
    return _checked_ball(question, goals, tuple(int(i) for i in used), radius)


def _bisected(question: Question, centers: Array, arms: Array, far: float) -> float | None:
    """Return how far from each center the answer changes, if that is the same for all."""
    low, high = np.zeros(len(centers)), np.full(len(centers), far)
    for _ in range(80):
        middle = (low + high) / 2
        inside = question(centers + middle[:, None] * arms, centers)
        low, high = np.where(inside, middle, low), np.where(inside, high, middle)
    radius = float(np.median(high))
    if not radius > 0 or np.ptp(high) > 1e-5 * radius:
        return None
    return float(f"{radius:.6g}") if abs(float(f"{radius:.6g}") / radius - 1) < 1e-6 else radius


def _checked_ball(
    question: Question, goals: Array, used: tuple[int, ...], radius: float
) -> DistanceRule | None:
    rng = np.random.default_rng(0)
    size = goals.shape[1]
    origin = np.zeros((len(used), size))
    on_edge = question(radius * np.eye(size)[list(used)], origin)
    # The rule does not include its threshold: where the question does, the next number is it.
    edge = float(np.nextafter(np.float32(radius), np.float32(np.inf)))
    rule = DistanceRule((used,), edge if on_edge.all() else radius)
    shares = np.repeat([0.01, 0.5, 0.99, 0.9999, 1.0001, 1.01, 2, 10], 64)
    centers = goals[rng.integers(len(goals), size=len(shares))]
    arms = rng.normal(size=(len(shares), size))
    scale = np.linalg.norm(arms[:, list(used)], axis=1, keepdims=True)
    points = centers + shares[:, None] * radius * arms / scale
    return rule if np.array_equal(question(points, centers), shares < 1) else None


def _explained(evidence: Evidence) -> DistanceRule:
    """Return the threshold on the distance that explains everything that info says.

    Raises:
        _UnfitError: Info says nothing, or not enough, or something else.
    """
    if not evidence.probes.key:
        raise _UnfitError("its info says nothing of success")
    key = f"info[{evidence.probes.key!r}]"
    first, second = evidence.more(1), evidence.more(2)
    low, high = _bracket([evidence.probes, first], key)
    threshold = roundest(low, high)
    coordinates = tuple(range(first.desired.shape[1]))
    rule = DistanceRule((coordinates,), threshold, because=f"explains all {key} in random episodes")
    for probes in (evidence.probes, first, second):
        try:
            _check_word(probes, rule(probes.achieved, probes.desired)[1])
        except _UnfitError as error:
            raise _UnfitError(f"{key} is no threshold on the distance of the goals") from error
    return rule


def _bracket(probes: list[Probes], key: str) -> tuple[float, float]:
    """Return the largest distance of success and the smallest of none.

    Raises:
        _UnfitError: They do not tell the threshold.
    """
    distance = np.concatenate([np.linalg.norm(p.achieved - p.desired, axis=1) for p in probes])
    word = np.concatenate([p.word for p in probes])
    if not (word == 1).any():
        raise _UnfitError(
            f"{key} was never true in random episodes, so it says nothing of other goals"
        )
    if not (word == 0).any():
        raise _UnfitError(f"{key} was always true")
    low, high = float(distance[word == 1].max()), float(distance[word == 0].min())
    if low >= high:
        raise _UnfitError(f"{key} is no threshold on the distance of the goals")
    if high > 1.25 * low:
        raise _UnfitError(f"{key} was true within {low:.3g} and false from {high:.3g} on: too wide")
    return low, high


def roundest(low: float, high: float) -> float:
    """Return the number in (low, high] with the fewest digits."""
    for digits in itertools.count(1):
        unit = 10.0 ** (np.floor(np.log10(high)) + 1 - digits)
        number = float(f"{np.round((low + high) / 2 / unit) * unit:.12g}")
        if low < number <= high or digits > 12:
            return number
    raise AssertionError


def _nearest(probes: Probes) -> float:
    return float(np.linalg.norm(probes.achieved - probes.desired, axis=1).min())


def _given_function(evidence: Evidence, function: str | Function) -> FunctionRule:
    """Return a rule that asks a function of the user.

    Raises:
        ConfigurationError: It fails, or is not true at the goal itself.
    """
    if isinstance(function, str):
        reference, kept = function, None
        called = function_of(function)
    else:
        reference, kept = reference_of(function)
        called = function
    achieved, desired, at_goal = _pairs(evidence.probes)
    achieved, desired = achieved.astype(np.float32), desired.astype(np.float32)
    try:
        pairs = FunctionRule(reference, "pairs", called)
        reached = pairs.reached(achieved, desired)
    except Exception as error:
        text = " ".join(str(error).split())
        raise ConfigurationError(
            f"success_function {reference} fails on two goals of shape {achieved.shape[1:]}: "
            f"{type(error).__name__}: {text}"
        ) from error
    if not reached[at_goal].all():
        raise ConfigurationError(f"success_function {reference} is not true at the goal itself")
    if reached.all():
        raise ConfigurationError(f"success_function {reference} is true everywhere")
    how = _how(called, achieved, desired, reached)
    return FunctionRule(reference, how, kept)


def _how(function: Function, achieved: Array, desired: Array, reached: Array) -> How:
    """Return the fastest way to ask a function in which it answers the same."""
    import jax

    def same(answer: Function) -> bool:
        try:
            values = np.asarray(answer(achieved, desired))
        except Exception:  # it is not written for this way
            return False
        return values.dtype == np.bool_ and np.array_equal(values, reached)

    if not same(function):
        return "pairs"
    return "compiled" if same(jax.jit(function)) else "batched"
