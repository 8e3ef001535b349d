"""Whole states on disk: written completely or not at all, and checked before they are used."""

import json
import shutil
from dataclasses import asdict, dataclass
from pathlib import Path

from midway import files
from midway.errors import ConfigurationError
from midway.training import archive
from midway.training.archive import Stored
from midway.types import EnvSpec, JsonObject

KEPT = 2
"""Checkpoints kept: the newest, and the one before it should the newest be damaged."""

FORMAT = 2
"""Counted up when the files of a checkpoint change."""

STATE = "state.npz"
EARLIER = "default"
"""Folder of the arrays in checkpoints of format 1."""

MANIFEST = "manifest.json"
SET_ASIDE = ".set-aside"


@dataclass(frozen=True)
class Owner:
    """The run that checkpoints must be of.

    Attributes:
        run: Its identity.
        env: Environment name.
        agent: Agent name.
    """

    run: str
    env: str
    agent: str


class Checkpoints:
    """Checkpoints of one run, by environment step.

    A checkpoint is written under another name, its checksums after its arrays, and then renamed:
    what is called by its step is whole. Saving waits until everything is on disk: the arrays are
    donated to the next update, and a second copy of a replay of images would not fit beside the
    first.

    Args:
        folder: Their folder.
        owner: The run that they must be of; None to take any.
    """

    def __init__(self, folder: Path, owner: Owner | None = None) -> None:
        self._folder = folder.absolute()
        self._owner = owner

    def steps(self) -> list[int]:
        """Return the steps of all checkpoints, the newest last."""
        return steps_in(self._folder)

    def latest(self) -> int | None:
        """Return the step of the newest checkpoint."""
        return max(self.steps(), default=None)

    # --- writing ----------------------------------------------------------------------------------

    def save(self, step: int, state: Stored, spec: EnvSpec | None = None) -> None:
        """Write a state, a nested dictionary of arrays, unless that of this step is there.

        Args:
            step: Its environment step.
            state: The state.
            spec: The environment that it belongs to.

        Raises:
            OSError: It cannot be written; the checkpoints before it are as they were.
        """
        if step in self.steps():
            return
        unfinished = self._folder / f"{step}{files.UNFINISHED}"
        try:
            self.remove_unfinished()
            self._folder.mkdir(exist_ok=True)
            unfinished.mkdir()
            archive.write(unfinished / STATE, state)
            self._seal(unfinished, step, state, spec)
            unfinished.rename(self._folder / str(step))
            self.remove_old()
        except (OSError, ValueError) as error:
            shutil.rmtree(unfinished, ignore_errors=True)
            reason = (str(error).splitlines() or [type(error).__name__])[0]
            raise OSError(f"checkpoint of step {step} cannot be written: {reason}") from error

    def remove_old(self) -> None:
        """Remove all checkpoints but the newest ones, of which the newest must be whole."""
        for old in self.steps()[:-KEPT]:
            _remove(self._folder / str(old))

    def remove_unfinished(self) -> None:
        """Remove what a process that was killed did not finish writing or removing."""
        if self._folder.is_dir():
            for path in self._folder.glob(f"*{files.UNFINISHED}"):
                shutil.rmtree(path, ignore_errors=True)

    def set_aside_after(self, step: int) -> None:
        """Rename the checkpoints after a step, which the run is about to reach anew."""
        for later in (found for found in self.steps() if found > step):
            name = self._folder / f"{later}{SET_ASIDE}"
            number = 1
            while name.exists():
                number += 1
                name = name.with_name(f"{later}{SET_ASIDE}-{number}")
            (self._folder / str(later)).rename(name)

    def _seal(self, folder: Path, step: int, state: Stored, spec: EnvSpec | None) -> None:
        manifest = {
            "format": FORMAT,
            "step": step,
            "owner": asdict(self._owner) if self._owner else None,
            "spec": spec.to_json() if spec else None,
            "parts": sorted(state),
            "files": {name: files.checksum(folder / name) for name in _names(folder)},
        }
        files.write(folder / MANIFEST, json.dumps(files.sealed(manifest), indent=1).encode())

    # --- reading ----------------------------------------------------------------------------------

    def choose(self, step: int | None = None) -> int | None:
        """Return the step to go on from, whose checkpoint is whole; None if there is none at all.

        Args:
            step: The step that is wanted; None for the newest.

        Raises:
            ConfigurationError: It is damaged, missing or of another run; the text names the
                newest whole one before it.
        """
        wanted = self.latest() if step is None else step
        if wanted is None:
            return None
        try:
            self.verify(wanted)
        except ConfigurationError as error:
            whole = next((s for s in reversed(self.steps()) if s < wanted and self._whole(s)), None)
            offer = (
                "no older one is whole, to start anew"
                if whole is None
                else f"that of step {whole} is whole, to go on from it"
            )
            command = f"midway resume {self._folder.parent} --from {whole or 0}"
            raise ConfigurationError(f"{error}; {offer}: {command}") from None
        return wanted

    def verify(self, step: int) -> None:
        """Check every file of a checkpoint, and whose it is.

        Raises:
            ConfigurationError: A file is missing, added or changed, or it is of another run.
        """
        folder, name = self._folder / str(step), f"checkpoint of step {step}"
        if not folder.is_dir():
            raise ConfigurationError(f"{name} is not there: {self._folder / str(step)}")
        if (folder / EARLIER).is_dir():
            raise ConfigurationError(
                f"{name} was written by an earlier version of midway, which can go on from it; "
                "this one cannot"
            )
        manifest = self._manifest(step)
        try:
            if (manifest["format"], manifest["step"]) != (FORMAT, step):
                raise ConfigurationError(
                    f"{name} says it is of step {manifest['step']}, format {manifest['format']}; "
                    f"expected step {step}, format {FORMAT}"
                )
            if not isinstance(manifest["spec"], dict | None):
                raise TypeError(f"spec {manifest['spec']!r}")
            if not all(isinstance(part, str) for part in manifest["parts"]):
                raise TypeError(f"parts {manifest['parts']!r}")
            self._check_owner(name, manifest["owner"])
            _check_files(name, folder, manifest["files"])
        except (KeyError, TypeError, AttributeError) as error:
            raise ConfigurationError(f"{name}: {MANIFEST} not understood: {error}") from error

    def check_spec(self, step: int, spec: EnvSpec) -> None:
        """Check that the environment is described as it was when a checkpoint was written.

        Raises:
            ConfigurationError: It is not; the text names the first difference.
        """
        stored = self._manifest(step).get("spec") or {}
        now = json.loads(json.dumps(spec.to_json()))
        for name in stored.keys() & now.keys():
            if stored[name] != now[name]:
                raise ConfigurationError(
                    f"checkpoint of step {step} is of another environment: {name} "
                    f"{stored[name]}, expected {now[name]}"
                )

    def parts(self, step: int) -> set[str]:
        """Return the names of what a checkpoint holds."""
        return set(self._manifest(step)["parts"])

    def restore(self, step: int, like: Stored) -> Stored:
        """Return the state of a step, with the structure, shapes and dtypes of ``like``.

        Raises:
            ConfigurationError: The checkpoint is damaged or belongs to another run.
        """
        self.verify(step)
        try:
            return archive.read(self._folder / str(step) / STATE, like)
        except ConfigurationError as error:
            raise ConfigurationError(f"checkpoint of step {step}: {error}") from error

    def _whole(self, step: int) -> bool:
        try:
            self.verify(step)
        except ConfigurationError:
            return False
        return True

    def _manifest(self, step: int) -> JsonObject:
        """Return what a checkpoint says of itself."""
        path = self._folder / str(step) / MANIFEST
        try:
            manifest = files.parsed(path.read_text())
        except (OSError, ValueError) as error:
            reason = error.strerror if isinstance(error, OSError) else error
            raise ConfigurationError(
                f"checkpoint of step {step} is damaged: {MANIFEST}: {reason}"
            ) from error
        if not isinstance(manifest, dict) or files.SEAL not in manifest:
            raise ConfigurationError(
                f"checkpoint of step {step} is damaged: {MANIFEST} has no checksum"
            )
        files.check_seal(manifest, f"checkpoint of step {step}: {MANIFEST}")
        found: JsonObject = manifest
        return found

    def _check_owner(self, name: str, stored: JsonObject | None) -> None:
        expected = asdict(self._owner) if self._owner else {}
        for what in ("env", "agent", "run"):
            if expected and (found := (stored or {}).get(what)) != expected[what]:
                raise ConfigurationError(
                    f"{name} is of another run: {what} {found!r}, expected {expected[what]!r}"
                )


def steps_in(folder: Path) -> list[int]:
    """Return the steps of the checkpoints in a folder, the newest last."""
    if not folder.is_dir():
        return []
    return sorted(int(path.name) for path in folder.iterdir() if path.name.isdecimal())


def _names(folder: Path) -> list[str]:
    """Return the files of a checkpoint but its manifest."""
    found = (path for path in folder.rglob("*") if not path.is_dir())
    names = (path.relative_to(folder).as_posix() for path in found)
    return sorted(name for name in names if name != MANIFEST)


def _check_files(name: str, folder: Path, expected: dict[str, str]) -> None:
    """Check names and checksums of the files of a checkpoint.

    Raises:
        ConfigurationError: One is missing, added or changed; the text names the first.
    """
    there = set(_names(folder))
    for file, digest in expected.items():
        if file not in there:
            raise ConfigurationError(f"{name} is damaged: {file} is missing")
        try:
            found = files.checksum(folder / file)
        except OSError as error:
            raise ConfigurationError(f"{name} is damaged: {file}: {error.strerror}") from error
        if found != digest:
            raise ConfigurationError(
                f"{name} is damaged: SHA-256 of {file} {files.short(found)}, "
                f"expected {files.short(digest)}"
            )
    if more := sorted(there - expected.keys()):
        raise ConfigurationError(f"{name} is damaged: {more[0]} does not belong to it")


def _remove(folder: Path) -> None:
    """Remove a checkpoint under another name, so that no half of one is called by its step."""
    going = folder.rename(folder.with_name(f"{folder.name}{files.UNFINISHED}"))
    shutil.rmtree(going)
