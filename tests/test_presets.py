"""The table of presets: every row means something, and gives what the presets before it gave."""

import dataclasses
import json
from pathlib import Path

import pytest

from midway import presets, settings
from midway.agents import beyond
from midway.agents.registry import AGENTS
from midway.cli.main import main
from midway.envs.registry import ENVIRONMENTS, Declaration
from midway.errors import ConfigurationError
from midway.presets import RULES, Rule, Source
from midway.training.config import TrainConfig

GOLDEN = json.loads((Path(__file__).parent / "golden" / "presets.json").read_text())
RENAMED = {"encoder_updates": "freeze_encoder_after", "image_translation": "random_shift"}
"""Settings that commit 47b95e9 called otherwise."""

BEFORE = {key: tuple(key.split()) for key in GOLDEN["differences"]}
"""The combinations that commit 47b95e9 knew."""


OTHER = Declaration("Reach-v0", "Reach-v0", "other", "not midway's", ("uniform",), "")


def applicable(rule: Rule) -> list[tuple[str, str, str]]:
    return [
        (preset, env, agent)
        for preset in presets.NAMES
        for env, declaration in {**ENVIRONMENTS, OTHER.name: OTHER}.items()
        for agent in AGENTS
        if rule.applies(preset, declaration, agent)
    ]


def plain(config: object) -> dict[str, object]:
    """Return the settings as JSON has them."""
    found: dict[str, object] = json.loads(json.dumps(dataclasses.asdict(config)))  # type: ignore[call-overload]
    return found


def identity(rule: Rule) -> str:
    return f"{rule.preset} {rule.env} {rule.family} {rule.agent}"


@pytest.mark.parametrize("rule", RULES, ids=identity)
def test_every_rule_applies_to_something_and_every_key_is_a_setting_there(rule: Rule) -> None:
    combinations = applicable(rule)
    assert combinations
    assert rule.values
    for _, _, agent in combinations:
        known = {*settings.names(TrainConfig), *settings.names(AGENTS[agent].Config)}
        assert set(rule.values) <= known


@pytest.mark.parametrize("rule", RULES, ids=identity)
def test_every_rule_has_a_source(rule: Rule) -> None:
    assert rule.source.strip()
    assert rule.preset in ("*", *presets.NAMES)


@pytest.mark.parametrize("env", ENVIRONMENTS)
@pytest.mark.parametrize("agent", AGENTS)
def test_every_value_of_paper_has_a_source(env: str, agent: str) -> None:
    resolved = presets.resolve(env, agent, "paper")
    for config in (resolved.train, resolved.hyperparameters):
        for name in settings.names(config):
            assert resolved.sources[name].source, name


@pytest.mark.parametrize("key", BEFORE)
def test_values_are_those_of_the_presets_before(key: str) -> None:
    preset, env, agent = BEFORE[key]
    before = GOLDEN["paper ant-u"][agent] | GOLDEN["differences"][key]
    expected = {RENAMED.get(name, name): value for name, value in before.items()}
    # Frozen encoders were a matter of agents that had one, and no setting of states meant anything.
    expected.setdefault("freeze_encoder_after", 0)
    expected = NEW | expected
    expected["relabel"] = {**expected["relabel"], "future_discount": 1.0}
    resolved = presets.resolve(env, agent, preset)
    found = plain(resolved.train) | plain(resolved.hyperparameters)
    if preset == "quick":  # this machine's fastest
        expected["precision"] = found["precision"]
    differ = {n: (expected.get(n), found[n]) for n in found}
    differ = {n: pair for n, pair in differ.items() if pair[0] != pair[1]}
    if preset == "quick" and ENVIRONMENTS[env].family == "ant" and agent in FASTER:
        assert differ.keys() <= FASTER[agent]
    else:
        assert differ == INTENDED.get(key, {})


NEW = {"collect": True, "collect_limit": 0, "on_env_error": "stop", "normalise": False}
NEW |= vars(beyond.SubgoalSettings())
"""Settings that there were none of, with the values that stand for that."""

FASTER = {
    agent: {
        name
        for rule in presets.QUICK
        if "trials of ant-u" in rule.source and agent in rule.agent.split()
        for name in rule.values
    }
    for agent in ("ris", "sac")
}
"""What `quick` changed of the ant since, for faster learning."""

NO_IMAGES: dict[str, tuple[object, object]] = {"freeze_encoder_after": (15_000, 0)}

INTENDED = {"quick push-state ris": NO_IMAGES, "quick push-state sac": NO_IMAGES}
"""What is meant to differ, (before, now): where there are no images, no encoder is frozen."""


def test_later_rules_win(monkeypatch: pytest.MonkeyPatch) -> None:
    rules = (
        Rule("quick", {"batch_size": 1, "discount": 0.5}, "first"),
        Rule("*", {"batch_size": 2}, "second", env="point-*"),
        Rule("paper", {"batch_size": 3}, "of another preset"),
        Rule("quick", {"batch_size": 4}, "of another agent", agent="sac"),
    )
    monkeypatch.setattr(presets, "RULES", rules)
    resolved = presets.resolve("point-u", "ris")
    assert (resolved.train.batch_size, resolved.hyperparameters.discount) == (2, 0.5)
    assert resolved.sources["batch_size"] == Source("second")
    assert resolved.sources["discount"] == Source("first")
    resolved = presets.resolve("point-u", "ris", changes={"batch_size": "9"})
    assert resolved.train.batch_size == 9
    assert resolved.sources["batch_size"].source == "given"
    assert presets.resolve("ant-u", "ris").train.batch_size == 1


def test_a_misspelt_key_of_a_rule_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(presets, "RULES", (Rule("quick", {"batchsize": 1}, "nothing"),))
    with pytest.raises(ConfigurationError, match="unknown setting 'batchsize'"):
        presets.resolve("point-u", "ris")


# --- files ----------------------------------------------------------------------------------------

FILE = """
base = "paper"

[[rule]]
env = "point-*"
source = "ours"
values = { batch_size = 64, hidden = [32, 32] }

[[rule]]
agent = "sac"
values = { batch_size = 128 }
"""


def test_rules_of_a_file_come_after_those_of_its_base(tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(FILE)
    ris = presets.resolve("point-u", "ris", str(path))
    assert (ris.train.batch_size, ris.hyperparameters.hidden) == (64, (32, 32))
    assert ris.sources["batch_size"] == Source("ours")
    sac = presets.resolve("point-u", "sac", str(path))
    assert sac.train.batch_size == 128
    assert sac.sources["batch_size"] == Source("mine.toml")
    elsewhere = presets.resolve("ant-u", "ris", str(path))
    assert elsewhere[:2] == presets.resolve("ant-u", "ris", "paper")[:2]


def test_the_base_of_a_file_is_quick_where_it_names_none(tmp_path: Path) -> None:
    path = tmp_path / "empty.toml"
    path.write_text("")
    assert presets.resolve("ant-u", "ris", str(path))[:2] == presets.resolve("ant-u", "ris")[:2]


@pytest.mark.parametrize(
    ("content", "named"),
    [
        ("[[rule]]\nvalues = { batchsize = 3 }", "batchsize"),
        ("[[rule]]\nvalues = { batch_size = 0 }", "batch_size 0"),
        ("[[rule]]\nvalues = { batch_size = 'many' }", "many"),
        ("[[rule]]\nvalue = { batch_size = 3 }", "mine.toml"),
        ("[[rule]]\nenv = 'point-u'", "mine.toml"),
        ("[[rule]]\nvalues = 3", "mine.toml"),
        ("[[rule]]\nenv = 3\nvalues = { batch_size = 3 }", "mine.toml"),
        ("rule = 3", "mine.toml"),
        ("rule = [3]", "mine.toml"),
        ("base = 'slow'", "slow"),
        ("base = ['paper']", "paper"),
        ("batch_size = 3", "batch_size"),
        ("this is no TOML", "mine.toml"),
    ],
)
def test_a_file_that_is_not_understood_is_refused_in_one_line(
    tmp_path: Path, content: str, named: str
) -> None:
    path = tmp_path / "mine.toml"
    path.write_text(content)
    with pytest.raises(ConfigurationError) as error:
        presets.resolve("point-u", "ris", str(path))
    assert named in str(error.value)
    assert "\n" not in str(error.value)


def test_files_that_cannot_be_read_and_unknown_presets_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigurationError, match=r"none\.toml"):
        presets.resolve("point-u", "ris", str(tmp_path / "none.toml"))
    with pytest.raises(ConfigurationError, match="unknown preset 'slow': choose one of paper"):
        presets.resolve("point-u", "ris", "slow")


# --- the command ----------------------------------------------------------------------------------


def test_the_command_prints_value_and_source(capsys: pytest.CaptureFixture[str]) -> None:
    main(["presets", "point-u", "sac", "--preset", "paper", "--set", "batch_size=7"])
    lines = capsys.readouterr().out.splitlines()
    fields = {*settings.names(TrainConfig), *settings.names(AGENTS["sac"].Config)}
    assert {line.split()[0] for line in lines} == fields
    assert next(line for line in lines if line.startswith("batch_size ")).split()[1] == "7"
    assert next(line for line in lines if line.startswith("batch_size ")).endswith("given")
    assert next(line for line in lines if line.startswith("discount ")).endswith("table 1")


def test_values_that_are_not_the_papers_are_marked(capsys: pytest.CaptureFixture[str]) -> None:
    main(["presets", "ant-u", "leap", "--preset", "paper"])
    lines = capsys.readouterr().out.splitlines()
    marked = {line.split()[0] for line in lines if "not the paper's:" in line}
    assert {"vae_kl_weight", "vae_random_actions"} <= marked


def test_the_command_prints_one_json_object(capsys: pytest.CaptureFixture[str]) -> None:
    main(["presets", "push", "ris", "--json"])
    values = json.loads(capsys.readouterr().out)
    assert values["freeze_encoder_after"]["value"] == 15_000
    shares = {"own": 0.2, "random": 0.4, "future": 0.4, "future_discount": 1.0}
    assert values["relabel"]["value"] == shares
    assert all(row["source"] for row in values.values())
