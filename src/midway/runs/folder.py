"""The run folder: its configuration, its files, and the versions that made it."""

import dataclasses
import hashlib
import json
import re
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path

from midway import files
from midway.agents import registry
from midway.envs import registry as environments
from midway.envs.describing import Foreign
from midway.envs.layouts import Layout
from midway.envs.registry import Declaration
from midway.errors import ConfigurationError
from midway.plain import check_kinds
from midway.runs import lock
from midway.runs.provenance import provenance
from midway.settings import changed
from midway.training.checkpoint import Owner
from midway.training.config import TrainConfig
from midway.types import Hyperparameters, JsonObject

FORMAT = 4
"""Counted up when the files of a run change; those before are still understood."""

SEALED_SINCE = 3
"""The first format whose files all have checksums."""

GONE = {"hindsight_bound": False, "candidates_per_pair": 1, "candidate_pairs": 32}
"""Agents' settings up to format 3 that are no more, and the values with which they did nothing."""

OUTSIDE = ("steps", "devices", "stop_at", "on_env_error")
"""Settings that may change when a run is continued."""


@dataclass(frozen=True)
class RunConfig:
    """Everything that decides what a run computes.

    Attributes:
        env: Environment name.
        agent: Agent name.
        preset: Preset that the values were taken from, before any were changed.
        seed: The one seed of every generator.
        train: Settings of the loop.
        hyperparameters: The agent's ``Config``.
        foreign: What was decided about an environment that is not midway's, as JSON; None for
            midway's own, and for one that no other process could make.
        data: Name or folder of a Minari dataset that the replay was filled with.
        maze: Robot and letters of a maze of one's own, as JSON.
    """

    env: str
    agent: str
    preset: str
    seed: int
    train: TrainConfig
    hyperparameters: Hyperparameters
    foreign: JsonObject | None = None
    maze: JsonObject | None = None
    data: str | None = None

    def __post_init__(self) -> None:
        """Check the seed.

        Raises:
            ConfigurationError: It is none.
        """
        if type(self.seed) is not int or not 0 <= self.seed < 2**63:
            raise ConfigurationError(
                f"seed {self.seed!r}: must be a whole number from 0 to 2**63 - 1"
            )

    def declaration(self) -> Declaration:
        """Return the declaration of the environment.

        Raises:
            ConfigurationError: It cannot be found.
        """
        if self.maze is not None:
            return environments.own_maze(str(self.maze.get("robot")), Layout.from_json(self.maze))
        if self.foreign is None:
            return environments.entry(self.env)
        return environments.entry(Foreign.from_json(self.foreign))

    @property
    def rule_of_success(self) -> str:
        """What counts as success in an environment that is not midway's, in one line."""
        foreign = self.declaration().foreign
        return "" if foreign is None else foreign.description

    def to_json(self) -> JsonObject:
        """Return plain values."""
        return dataclasses.asdict(self)

    @property
    def identity(self) -> str:
        """What runs that compute the same have in common, however long they are."""
        values = self.to_json()
        values["train"] = {k: v for k, v in values["train"].items() if k not in OUTSIDE}
        return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()[:16]

    @staticmethod
    def from_json(values: JsonObject) -> "RunConfig":
        """Return the configuration of ``to_json``.

        Raises:
            ConfigurationError: A value is missing, unknown or out of range.
        """
        try:
            values = _of_this_format(values)
            agent = registry.get(values["agent"])
            config = RunConfig(
                env=values["env"],
                agent=values["agent"],
                preset=values["preset"],
                seed=values["seed"],
                train=changed(TrainConfig(), values["train"]),
                hyperparameters=changed(agent.Config(), values["hyperparameters"]),
                foreign=values.get("foreign"),
                maze=values.get("maze"),
                data=values.get("data"),
            )
            check_kinds(config)
        except (KeyError, TypeError, AttributeError) as error:
            raise ConfigurationError(f"configuration not understood: {error}") from error
        return config


def _of_this_format(values: JsonObject) -> JsonObject:
    """Return the values with the names that they have in this format."""
    written = values.get("format", FORMAT)
    if written >= FORMAT:
        return values
    train, agent = {**values["train"]}, {**values["hyperparameters"]}
    agent = {name: value for name, value in agent.items() if name not in GONE}
    if written == 1:
        train["freeze_encoder_after"] = agent.pop("encoder_updates", 0)
        if "image_translation" in agent:
            agent["random_shift"] = agent.pop("image_translation")
    return {**values, "train": train, "hyperparameters": agent}


def run_name(env: str, agent: str, seed: int) -> str:
    """Return the name of a run in file names; ids and dotted paths become plain words."""
    parts = [re.sub(r"[^\w.-]+", "-", part).strip("-") for part in (env, agent)]
    return "-".join([*parts, f"seed{seed}"])


ZOO = Path(__file__).parents[3] / "zoo"
"""Trained policies of the repository; a wheel holds none, and looks in the working directory."""


@dataclass(frozen=True)
class RunFolder:
    """Names of the files of a run."""

    path: Path

    @classmethod
    def at(cls, path: str | Path) -> "RunFolder":
        """Return the folder of a path, or of a policy that comes with midway: ``zoo:ant-u-ris``.

        Raises:
            ConfigurationError: There is no such policy.
        """
        name = str(path).removeprefix("zoo:")
        if name == str(path):
            return cls(Path(path))
        zoo = ZOO if ZOO.is_dir() else Path("zoo")
        known = sorted(folder.parent.name for folder in zoo.glob("*/policy.json"))
        if name not in known:
            there = ", ".join(known) or "nothing here: it comes with a checkout, run this in one"
            raise ConfigurationError(f"{path}: the zoo has {there}")
        return cls(zoo / name)

    @property
    def config_file(self) -> Path:
        """``config.json``: every value, versions, commit and command."""
        return self.path / "config.json"

    @property
    def lock_file(self) -> Path:
        """``lock``: who trains the run; empty when nobody does."""
        return self.path / "lock"

    @property
    def metrics_file(self) -> Path:
        """``metrics.csv``: scalars of the updates and of collection."""
        return self.path / "metrics.csv"

    @property
    def evaluation_file(self) -> Path:
        """``evaluation.csv``: success by step, task and kind of action."""
        return self.path / "evaluation.csv"

    @property
    def checkpoints(self) -> Path:
        """Folder of the whole states that a run continues from."""
        return self.path / "checkpoints"

    @property
    def policy_weights(self) -> Path:
        """``policy.safetensors``: the networks."""
        return self.path / "policy.safetensors"

    @property
    def past_policies(self) -> Path:
        """Folder of weights that were kept on the way: snapshots, and the best."""
        return self.path / "policies"

    @property
    def best_weights(self) -> Path:
        """``policies/best.safetensors``: the weights of the best policy, and how good it is."""
        return self.past_policies / "best.safetensors"

    @property
    def policy_config(self) -> Path:
        """``policy.json``: what is needed to build the networks."""
        return self.path / "policy.json"

    @property
    def figures(self) -> Path:
        """Folder of figures."""
        return self.path / "figures"

    def prepare(self) -> None:
        """Make the folder of a new run, if it is not there.

        Raises:
            ConfigurationError: There is a run already, other files lie there, or it cannot be made.
        """
        try:
            if self.path.exists() and (not self.path.is_dir() or self.strangers()):
                hint = (
                    "use `midway resume` or --overwrite"
                    if self.config_file.exists()
                    else "choose another"
                )
                raise ConfigurationError(f"run folder {self.path} is not empty: {hint}")
            self.path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ConfigurationError(
                f"cannot make run folder {self.path}: {error.strerror}"
            ) from error

    def strangers(self) -> list[Path]:
        """Return what is there but what a process leaves that is killed before ``config.json``."""
        left = (self.lock_file.name, self.config_file.name + files.UNFINISHED)
        return [path for path in self.path.iterdir() if path.name not in left]

    def create(self, config: RunConfig) -> None:
        """Make the folder and write ``config.json``.

        Raises:
            ConfigurationError: There is a run already, other files lie there, or it cannot be made.
        """
        self.prepare()
        values = {**config.to_json(), "run": config.identity, "format": FORMAT, **provenance()}
        try:
            write_json(self.config_file, values)
        except OSError as error:
            raise ConfigurationError(
                f"cannot make run folder {self.path}: {error.strerror}"
            ) from error

    def check_goes_on(self) -> None:
        """Check that this version learns what the run has learned so far.

        Raises:
            ConfigurationError: It was begun with a setting that is no more.
        """
        agent = read_json(self.config_file)["hyperparameters"]
        on = [f"{name}={agent[name]}" for name, off in GONE.items() if agent.get(name, off) != off]
        if on:
            raise ConfigurationError(
                f"{self.path} learned with {', '.join(on)}, which midway no longer has: its policy "
                "can be evaluated and watched, the run cannot be continued"
            )

    def note_resume(self, config: RunConfig) -> None:
        """Add to ``config.json`` how the run was continued, and its new number of steps."""
        values = read_json(self.config_file)
        again = {"format": FORMAT, **provenance(), "steps": config.train.steps}
        continued = {**values, **config.to_json(), "resumed": [*values.get("resumed", []), again]}
        write_json(self.config_file, continued)

    def note_end(self, step: int | None) -> None:
        """Add to ``config.json`` the step that the run was ended at early; None: it goes on."""
        values = {name: v for name, v in read_json(self.config_file).items() if name != "ended_at"}
        write_json(self.config_file, values | ({} if step is None else {"ended_at": step}))

    def ended_at(self) -> int | None:
        """Return the step that the run was ended at before its settings do, if it was.

        Raises:
            ConfigurationError: This is no run folder.
        """
        step = read_json(self.config_file).get("ended_at")
        return step if isinstance(step, int) else None

    def remove_unfinished(self) -> None:
        """Remove files that a process which was killed did not finish writing."""
        for folder in (self.path, self.past_policies):
            for path in folder.glob(f"*{files.UNFINISHED}"):
                path.unlink(missing_ok=True)

    def lock(self) -> AbstractContextManager[None]:
        """Keep other processes from training the same run.

        Raises:
            ConfigurationError: Another process trains it; the text names it.
        """
        return lock.hold(self.lock_file, f"run folder {self.path}")

    def in_use(self) -> bool:
        """Return whether a process trains this run now."""
        return lock.held(self.lock_file)

    def identity(self, config: RunConfig) -> str:
        """Return the run's identity: what was written at its start, else its configuration's."""
        if not self.config_file.exists():
            return config.identity
        return str(read_json(self.config_file).get("run", config.identity))

    def owner(self, config: RunConfig) -> Owner:
        """Return whose the checkpoints of the run must be."""
        return Owner(self.identity(config), config.env, config.agent)

    def load_config(self) -> RunConfig:
        """Return the configuration of the run.

        Raises:
            ConfigurationError: This is no run folder, or not one of this version.
        """
        values = read_json(self.config_file)
        check_format(values, self.config_file)
        try:
            return RunConfig.from_json(values)
        except ConfigurationError as error:
            raise ConfigurationError(f"{self.config_file}: {error}") from error


def write_json(path: Path, values: JsonObject) -> None:
    """Write values with their checksum, in a file that is there whole or not at all.

    Raises:
        OSError: It cannot be written.
    """
    files.write(path, (json.dumps(files.sealed(values), indent=2) + "\n").encode())


def read_json(path: Path) -> JsonObject:
    """Return the object in a JSON file.

    Raises:
        ConfigurationError: The file cannot be read, holds no JSON object, or was changed.
    """
    try:
        values = files.parsed(path.read_text())
    except OSError as error:
        raise ConfigurationError(
            f"{path.parent} is no readable run folder: {path.name}: {error.strerror}"
        ) from error
    except ValueError as error:  # no JSON, no UTF-8, absurd numbers or depth
        raise ConfigurationError(f"{path} is damaged: {error}") from error
    if not isinstance(values, dict):
        raise ConfigurationError(f"{path} is damaged: it holds no JSON object")
    files.check_seal(values, path)
    return values


def check_format(values: JsonObject, path: Path) -> None:
    """Check that a file is of a format that is understood, and has a checksum where it must.

    Raises:
        ConfigurationError: It is not, or has none.
    """
    written = values.get("format")
    if type(written) is not int or not 1 <= written <= FORMAT:
        raise ConfigurationError(
            f"{path}: not a run of this version of midway: format {written!r}, "
            f"expected 1 to {FORMAT}"
        )
    if written >= SEALED_SINCE and files.SEAL not in values:
        raise ConfigurationError(f"{path} is damaged: expected a checksum named {files.SEAL}")
