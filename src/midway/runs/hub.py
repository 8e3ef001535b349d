"""Run folders on the Hugging Face hub: what a policy needs, and the numbers of its run."""

from pathlib import Path
from typing import Any

from midway import files
from midway.errors import ConfigurationError, needing
from midway.runs import policy as policies
from midway.runs.folder import RunFolder
from midway.runs.policy import Policy

SHARED = ("*.json", "*.csv", "*.safetensors", "README.md")
"""Files that are shared."""

KEPT_BACK = ("*/*",)
"""What stays here: checkpoints with their replay, snapshots, events and figures."""

CARD = """---
library_name: midway
tags: [reinforcement-learning, goal-conditioned, {agent}, {env}]
---

# {agent} on {env}

Trained with midway, preset `{preset}`, seed {seed}; the policy is of step {step}.

```python
import midway

policy = midway.load(midway.pull("{repository}"))
action = policy.predict(observation)  # the dictionary of the environment
```
"""


def push(path: Path, repository: str, private: bool = False) -> str:
    """Share a run's policy, settings and numbers on the hub; return their address.

    Args:
        path: The run folder.
        repository: ``USER/NAME``; it is made if it is not there.
        private: Whether a new one is private.

    Raises:
        ConfigurationError: The folder holds no policy, the package is not installed, or the hub
            refuses.
    """
    folder, hub = RunFolder(path), _hub("push")
    policy = policies.load(folder)
    files.write(path / "README.md", _card(policy, repository).encode())
    try:
        api = hub.HfApi()
        api.create_repo(repository, private=private, exist_ok=True)
        found = api.upload_folder(
            repo_id=repository,
            folder_path=str(path),
            allow_patterns=list(SHARED),
            ignore_patterns=list(KEPT_BACK),
        )
    except (hub.errors.HfHubHTTPError, ValueError, OSError) as error:
        raise ConfigurationError(f"push {repository}: {error}") from error
    return str(found)


def pull(repository: str, out: str | Path | None = None) -> Path:
    """Fetch a shared run; return its folder, for `midway.load` and other commands.

    Args:
        repository: ``USER/NAME``.
        out: The folder; default: ``runs/NAME``.

    Raises:
        ConfigurationError: The folder holds something else, there is no such repository, it holds
            no policy, or the package is not installed.
    """
    hub, path = _hub("pull"), Path(out or Path("runs") / repository.rpartition("/")[2])
    if path.exists() and any(path.iterdir()):
        raise ConfigurationError(f"pull: folder {path} is not empty: choose another")
    try:
        hub.snapshot_download(repository, local_dir=str(path), allow_patterns=list(SHARED))
    except (hub.errors.HfHubHTTPError, ValueError, OSError) as error:
        raise ConfigurationError(f"pull {repository}: {error}") from error
    policies.load(RunFolder(path))
    return path


def _card(policy: Policy, repository: str) -> str:
    config = policy.config
    names = {"agent": config.agent, "env": config.env, "preset": config.preset}
    return CARD.format(**names, seed=config.seed, step=policy.step, repository=repository)


def _hub(command: str) -> Any:
    with needing("hub", command):
        import huggingface_hub
        import huggingface_hub.errors
    return huggingface_hub
