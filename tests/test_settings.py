"""Settings: bounds, types, text, and the way through a file and back."""

import dataclasses
import json
import math
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from midway.agents.registry import AGENTS
from midway.errors import ConfigurationError
from midway.runs.folder import RunConfig
from midway.settings import Allowed, changed, check, declared, names, setting, split
from midway.training.config import TrainConfig
from midway.types import RelabelMix

CONFIGS: dict[str, Any] = {"train": TrainConfig} | {n: a.Config for n, a in AGENTS.items()}
EVERY = [
    pytest.param(config, name, id=f"{owner}-{name}")
    for owner, config in CONFIGS.items()
    for name, _, _ in declared(config())
]


def numbers_around(allowed: Allowed, whole: bool) -> tuple[list[Any], list[Any]]:
    """Return numbers that are just allowed, and numbers that are just not."""
    step = 1 if whole else 1e-9
    good, bad = [], []
    if allowed.least is not None:
        good.append(allowed.least)
        bad.append(allowed.least - (1 if whole else 1e-3))
    if allowed.most is not None:
        good.append(allowed.most)
        bad.append(allowed.most + 1)
    if allowed.above is not None:
        good.append(allowed.above + step)
        bad += [allowed.above, allowed.above - 1]
    if allowed.below is not None:
        good.append(allowed.below - step)
        bad += [allowed.below, allowed.below + 1]
    kind = int if whole else float
    return [kind(x) for x in good], [kind(x) for x in bad]


def cases() -> tuple[list[Any], list[Any]]:
    allowed, refused = [], []
    for owner, config in CONFIGS.items():
        for name, value, rule in declared(config()):
            example = value[0] if isinstance(value, tuple) else value
            if not isinstance(example, int | float) or rule.choices:
                continue
            good, bad = numbers_around(rule, isinstance(example, int))
            if isinstance(example, float):
                bad += [math.nan, math.inf, -math.inf]
            for numbers, into in ((good, allowed), (bad, refused)):
                for x in numbers:
                    given = (example, x) if isinstance(value, tuple) else x
                    into.append(pytest.param(config, name, given, id=f"{owner}-{name}-{x}"))
    return allowed, refused


ALLOWED, REFUSED = cases()


@pytest.mark.parametrize(("config", "name", "value"), ALLOWED)
def test_numbers_at_the_bounds_are_allowed(config: Any, name: str, value: Any) -> None:
    others = {"random_steps": 10**12} if name == "num_envs" else {}
    others = others if config is TrainConfig else {}
    made = config(**others, **{name: value})
    assert getattr(made, name) == value
    assert getattr(changed(made, {name: str(value)}), name) == value


@pytest.mark.parametrize(("config", "name", "value"), REFUSED)
def test_numbers_beyond_the_bounds_are_refused(config: Any, name: str, value: Any) -> None:
    for make in (lambda: config(**{name: value}), lambda: changed(config(), {name: value})):
        with pytest.raises(ConfigurationError, match=rf"^{name} ") as error:
            make()
        assert "\n" not in str(error.value)


@pytest.mark.parametrize(("config", "name"), EVERY)
def test_another_type_is_refused_in_one_line(config: Any, name: str) -> None:
    default = getattr(config(), name)
    wrong: list[Any] = [None, object(), {}]
    wrong += [3] if isinstance(default, str | tuple) else ["many", [1], 1j]
    wrong += [2] if isinstance(default, bool) else [True]
    for value in wrong:
        with pytest.raises(ConfigurationError, match=name) as error:
            changed(config(), {name: value})
        assert "\n" not in str(error.value)


@pytest.mark.parametrize(("config", "name"), EVERY)
def test_every_setting_says_where_it_comes_from(config: Any, name: str) -> None:
    [rule] = [allowed for found, _, allowed in declared(config()) if found == name]
    assert rule.source or name == "relabel"


@pytest.mark.parametrize("config", [c for n, c in CONFIGS.items() if n != "train"])
def test_choices_are_listed(config: Any) -> None:
    # Types are checked as the tests run, and refuse f16 before the setting can: ask it itself.
    [rule] = [allowed for name, _, allowed in declared(config()) if name == "precision"]
    assert rule.complaint("f16") == "choose one of f32, bf16"
    assert rule.complaint("bf16") == ""
    assert config(precision="bf16").precision == "bf16"


@pytest.mark.parametrize(
    ("agent", "change"),
    [("ris", "discount=1.0"), ("ris", "num_subgoals=0"), ("ris", "advantage_temperature=0")],
)
def test_what_would_divide_by_nothing_is_refused(agent: str, change: str) -> None:
    name, _, value = change.partition("=")
    with pytest.raises(ConfigurationError, match=name):
        changed(AGENTS[agent].Config(), {name: value})


@dataclasses.dataclass(frozen=True)
class Some:
    """One setting of each kind."""

    count: int = setting(3, "here", "a number", least=1, most=2**70)
    rate: float = setting(0.5, "here", "a rate", above=0, most=1)
    text: str = setting("word", "here")
    sizes: tuple[int, ...] = setting((4, 5), "here", least=1)
    shares: tuple[float, ...] = setting((0.5,), "here", above=0, most=1)
    relabel: RelabelMix = dataclasses.field(default_factory=RelabelMix)

    def __post_init__(self) -> None:
        """Check the values."""
        check(self)


@pytest.mark.parametrize(
    ("name", "given", "wanted"),
    [
        ("count", "7", 7),
        ("count", 7.0, 7),
        ("count", "7e2", 700),
        ("count", str(2**70), 2**70),
        ("rate", "1", 1.0),
        ("rate", 1, 1.0),
        ("text", "7", "7"),
        ("sizes", "(1, 2)", (1, 2)),
        ("sizes", "[1, 2.0]", (1, 2)),
        ("sizes", [1, 2], (1, 2)),
        ("shares", [1, 0.5], (1.0, 0.5)),
        ("relabel", "(0.5, 0.25, 0.25)", RelabelMix(0.5, 0.25, 0.25)),
        ("relabel", {"own": 1.0, "random": 0.0, "future": 0.0}, RelabelMix(1.0, 0.0, 0.0)),
        ("relabel", RelabelMix(1.0, 0.0, 0.0), RelabelMix(1.0, 0.0, 0.0)),
    ],
)
def test_values_come_in_the_type_of_the_default(name: str, given: Any, wanted: Any) -> None:
    found = getattr(changed(Some(), {name: given}), name)
    assert found == wanted
    assert type(found) is type(wanted)


@pytest.mark.parametrize(
    ("name", "given"),
    [
        ("count", "0"),
        ("count", "1.5"),
        ("count", 10**30),
        ("count", "(1,)"),
        ("count", "__import__('os')"),
        ("rate", "nan"),
        ("rate", math.nan),
        ("rate", "1e999"),
        ("rate", 10**400),
        ("sizes", "(1, 0)"),
        ("sizes", "(1, 'a')"),
        ("sizes", "4"),
        ("sizes", "(1.5,)"),
        ("shares", (0.5, math.nan)),
        ("relabel", "(1, 1, 1)"),
        ("relabel", "(1, 0)"),
        ("relabel", {"mine": 1.0}),
        ("relabel", {}),
        ("relabel", "()"),
        ("relabel", "word"),
    ],
)
def test_values_that_cannot_be_had_are_refused_in_one_line(name: str, given: Any) -> None:
    with pytest.raises(ConfigurationError) as error:
        changed(Some(), {name: given})
    assert "\n" not in str(error.value)


def test_unknown_names_are_refused_with_those_that_are_known() -> None:
    with pytest.raises(ConfigurationError) as error:
        changed(Some(), {"counts": 3})
    listed = ", ".join(names(Some))
    assert str(error.value) == f"unknown setting 'counts': use one of {listed}"


def test_changes_are_divided_among_the_configurations_that_have_them() -> None:
    changes = {"count": 3, "steps": 5}
    assert split(changes, [Some(), TrainConfig()]) == [{"count": 3}, {"steps": 5}]


def test_settings_that_must_fit_each_other_are_refused() -> None:
    with pytest.raises(ConfigurationError, match="random_steps 2: at least one step"):
        TrainConfig(num_envs=4, random_steps=2)


def values_of(config: Any) -> st.SearchStrategy[dict[str, Any]]:
    """Return settings that are allowed one by one."""

    def of(value: Any, allowed: Allowed) -> st.SearchStrategy[Any]:
        if allowed.choices:
            return st.sampled_from(allowed.choices)
        if isinstance(value, bool):
            return st.booleans()
        if isinstance(value, tuple):
            return st.lists(of(value[0], allowed), max_size=4).map(tuple)
        if isinstance(value, int):
            return st.integers(int(allowed.least or 0), int(min(allowed.most or 10**9, 10**9)))
        if isinstance(value, float):
            low = allowed.least if allowed.least is not None else allowed.above
            high = allowed.most if allowed.most is not None else allowed.below
            return st.floats(
                float(low or 0),
                None if high is None else float(high),
                exclude_min=allowed.above is not None,
                exclude_max=allowed.below is not None,
                allow_nan=False,
                allow_infinity=False,
            )
        return st.text(max_size=20) if isinstance(value, str) else st.just(value)

    return st.fixed_dictionaries({}, optional={n: of(v, a) for n, v, a in declared(config())})


@pytest.mark.parametrize("agent", AGENTS)
@given(data=st.data())
def test_configurations_come_back_from_their_files(agent: str, data: st.DataObject) -> None:
    train = data.draw(values_of(TrainConfig))
    train |= {"devices": 1, "random_steps": max(10**5, train.get("num_envs", 1))}
    hyperparameters = AGENTS[agent].Config(**data.draw(values_of(AGENTS[agent].Config)))
    config = RunConfig("point-u", agent, "quick", 3, TrainConfig(**train), hyperparameters)
    written = json.loads(json.dumps({**config.to_json(), "format": 2}))
    assert RunConfig.from_json(written) == config
