"""Commands that list: environments, settings, runs, and what the machine has."""

import dataclasses
import sys
from pathlib import Path

from tyro.conf import Positional

from midway.cli.about import NOTHING, AboutEnv
from midway.cli.parsing import Changes, plain, print_json, settings


def envs(json: bool = False) -> None:
    """List the environments and their tasks.

    Args:
        json: Print one JSON object.
    """
    from midway.envs.registry import ENVIRONMENTS

    if json:
        entries = {
            name: {"id": e.gym_id, "tasks": list(e.tasks), "description": e.description}
            for name, e in ENVIRONMENTS.items()
        }
        print_json(entries)
        return
    for name, entry in ENVIRONMENTS.items():
        print(f"{name:12} {entry.gym_id:26} {entry.description}")
        print(f"{'':12} tasks: {', '.join(entry.tasks)}")


def doctor(json: bool = False) -> None:
    """Say what this machine has and what is missing.

    Args:
        json: Print one JSON object.
    """
    from midway.cli.doctor import checks

    results = checks()
    if json:
        print_json({check.name: dataclasses.asdict(check) for check in results})
    else:
        for check in results:
            print(f"{'ok     ' if check.ok else 'MISSING'} {check.name:12} {check.detail}")
    if not all(check.ok for check in results if check.needed):
        sys.exit(1)


def presets(
    env: Positional[str] = "ant-u",
    agent: Positional[str] = "ris",
    preset: str = "quick",
    set: Changes = (),
    json: bool = False,
    about: AboutEnv = NOTHING,
) -> None:
    """Print every setting of a preset with its value and where that comes from.

    Args:
        env: Environment name.
        agent: Agent name.
        preset: paper, quick, or a file ending in .toml.
        set: Other settings of the preset, as NAME=VALUE.
        json: Print one JSON object.
        about: What midway must be told of an environment that is not its own.
    """
    from midway import presets as rules
    from midway import settings as declarations

    resolved = rules.resolve(about.env(env), agent, preset, settings(set))
    rows = [
        (name, value, resolved.sources.get(name, rules.Source("default of the agent")), allowed)
        for config in (resolved.train, resolved.hyperparameters)
        for name, value, allowed in declarations.declared(config)
    ]
    if json:
        print_json(
            {name: {"value": plain(value), **source._asdict()} for name, value, source, _ in rows}
        )
        return
    for name, value, source, allowed in rows:
        mark = f" [not the paper's: {source.deviates}]" if source.deviates else ""
        print(f"{name:22} {plain(value)!s:22} {allowed.meaning:38} {source.source}{mark}".rstrip())


def runs(folder: Positional[Path] = Path("runs"), json: bool = False) -> None:
    """List the runs below a folder: their state, steps and success.

    running: a process trains it; interrupted: it can go on; finished; broken: it cannot be read.

    Args:
        folder: Folder of run folders and sweeps.
        json: Print one JSON object.
    """
    from midway.cluster.jobs import last_success
    from midway.runs.folder import RunFolder
    from midway.runs.states import found_below, state_of

    rows = {}
    for path in found_below(folder):
        step, success = last_success(RunFolder(path).evaluation_file)
        rows[str(path)] = {**state_of(path)._asdict(), "success": success, "evaluated_at": step}
    if json:
        print_json(rows)
        return
    width = max(map(len, rows), default=0)
    for name, row in rows.items():
        reached = "" if row["success"] is None else f"success {row['success']:.0%}"
        steps = "" if row["steps"] is None else f"{row['step']:,}/{row['steps']:,}"
        print(f"{name:{width}}  {row['state']:11}  {steps:>19}  {reached}  {row['why']}".rstrip())
    if not rows:
        print(f"no runs below {folder}")
