"""Mutated files of every kind that a user may be given: they load, or are refused with one line.

``python tests/fuzz.py --each 100000`` is the long form. Mutant N of a seed is always the same;
``--kind config --show N`` writes it to standard output.
"""

import argparse
import dataclasses
import json
import random
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import numpy as np

from midway import api, files, presets, tables
from midway.agents import registry as agents
from midway.cluster.jobs import last_success
from midway.envs import layouts, registry
from midway.envs.describing import Foreign, Settings
from midway.envs.sources import Source
from midway.envs.success import AskedRule, DistanceRule
from midway.errors import ConfigurationError
from midway.reports import runs
from midway.runs import complete, policy
from midway.runs.folder import FORMAT, RunConfig, RunFolder, write_json
from midway.training import state
from midway.training.arrays import load_arrays, networks_of, save_arrays
from midway.training.checkpoint import MANIFEST, Checkpoints
from midway.types import EnvSpec
from mutations import Mutate, either, of_arrays, of_bytes, of_cells, of_object, of_words

SECONDS = 5.0
"""Processor time that one file may take."""

MEMORY = 500_000_000
"""Bytes by which the most memory of this process may grow while the files of a kind are read."""

ADDRESSES = 16_000_000_000
"""Bytes of addresses that may be asked for: more is a MemoryError, not a dead machine."""

SELDOM = 50
"""Every so many mutants, what takes longer is tried too: shapes, a simulator, arrays restored."""

FITTING = 0.01
"""Share of changed checkpoints whose checksums fit, so that their arrays are read: 50 ms each."""

SMALL: dict[str, object] = {"hidden": (8,), "batch_size": 8, "num_envs": 4, "random_steps": 40}


class Kind(NamedTuple):
    """Files of one kind.

    Attributes:
        file: Where a mutant is written.
        whole: Contents of whole files.
        mutate: Makes a mutant of one of them.
        use: Reads the mutant as midway does; is told whether what takes longer is tried.
    """

    file: Path
    whole: list[bytes]
    mutate: Mutate
    use: Callable[[bool], object]


# --- whole files ----------------------------------------------------------------------------------


def configurations() -> list[RunConfig]:
    """Return runs of midway's own environments, of a maze of one's own, and of others."""
    own = registry.own_maze("point", layouts.Layout("mine", ("S.", ".G")))
    rule = DistanceRule(groups=((0, 1),), threshold=0.5, because="given")
    spec = registry.entry("point-u").factory().goal_spec
    spec = dataclasses.replace(spec, name="fakes:Plane", task=rule, can_fail=True)
    other = Foreign(Source("fakes:Plane"), spec, Settings(0.5), 0.001)
    asked = AskedRule(other.source, "compute_reward", -0.5, True, (4,))
    judged = dataclasses.replace(other, spec=dataclasses.replace(spec, task=asked))
    return [
        api.configure("point-u", "sac", changes=SMALL),
        api.configure("ant-u", "ris"),
        api.configure("push", "leap"),
        api.configure(own, "tdm"),
        api.configure(other, "crl"),
        api.configure(judged, "sac"),
    ]


def whole_run(path: Path) -> tuple[RunFolder, RunConfig, EnvSpec]:
    """Write a run folder with every file but tables; its weights are zeros."""
    folder, config = RunFolder(path), api.configure("point-u", "sac", changes=SMALL)
    folder.create(config)
    spec = registry.entry("point-u").factory().goal_spec
    description = {"format": FORMAT, "step": 40, "run": config.identity, **config.to_json()}
    write_json(folder.policy_config, {**description, "spec": spec.to_json()})
    networks = networks_of(zeros(config, spec), agents.get(config.agent).networks)
    save_arrays(folder.policy_weights, networks, {"run": config.identity, "step": 40})
    Checkpoints(folder.checkpoints, folder.owner(config)).save(40, stored(), spec)
    return folder, config, spec


def zeros(config: RunConfig, spec: EnvSpec) -> Any:
    """Return an agent's state of zeros; nothing is compiled."""
    create = agents.get(config.agent).create
    shapes = eqx.filter_eval_shape(create, config.hyperparameters, spec, jax.random.key(0))
    return jax.tree.map(
        lambda leaf: (
            np.zeros(leaf.shape, leaf.dtype)
            if isinstance(leaf, jax.ShapeDtypeStruct)
            and not jax.dtypes.issubdtype(leaf.dtype, jax.dtypes.prng_key)
            else leaf
        ),
        shapes,
    )


def stored() -> dict[str, Any]:
    """Return a small state as checkpoints hold it."""
    agent = {"policy.weight": jax.numpy.zeros((4, 2)), "policy.bias": jax.numpy.zeros(2)}
    return {"agent": agent, "collector": {"observation": np.zeros((4, 4))}, "step": np.array(40)}


def table(more: tuple[str, ...]) -> bytes:
    """Return a CSV file of four rows."""
    columns = ("step", "updates", "seconds", "final_distance", *more)
    text = {"task": "hard", "actions": "mean"}
    rows = [
        [text.get(name, str(40 * row + 0.5 * (name != "step"))) for name in columns]
        for row in range(4)
    ]
    return "".join(",".join(row) + "\r\n" for row in [list(columns), *rows]).encode()


PRESET = b"""
base = "quick"
[[rule]]
env = "point-* ant-u"
agent = "sac"
family = "*"
source = "trials"
values = { batch_size = 64, hidden = [8, 8], relabel = { own = 0.2, random = 0.4, future = 0.4 } }
[[rule]]
values = { num_envs = 4, critic_learning_rate = 1e-3, task = "uniform" }
"""

YAML = b"map: |\n  #####\n  #S.G#\n  #...#\n  #####\ncell: 4.0\n"
LETTERS = b"#######\n#S...G#\n#.###.#\n#.....#\n#######\n"


# --- how each is used -----------------------------------------------------------------------------


def use_config(folder: RunFolder, seldom: bool) -> None:
    """Ask a configuration what a run and a report ask."""
    config = folder.load_config()
    declared = config.declaration()
    f"{folder.owner(config)} {config} {config.rule_of_success}".encode()
    complete.missing(folder, config.train.steps)
    complete.had_checkpoint(folder, config)
    runs.read(folder.path)
    if seldom and declared.foreign is None:
        state.check(api.setup_of(config, folder))


def use_policy(folder: RunFolder, seldom: bool) -> None:
    """Read a policy's description, and sometimes its weights and the shapes that it asks for."""
    _, config, spec = policy.described(folder)
    f"{config} {spec}".encode()
    if seldom:
        complete.policy_step(folder)
        policy.expected(config, spec, frozen=False)


def use_checkpoint(found: Checkpoints, spec: EnvSpec) -> None:
    """Choose a checkpoint, and restore it if it is whole."""
    step = found.choose()
    if step is not None:
        found.check_spec(step, spec)
        found.parts(step)
        found.restore(step, stored())


def use_table(path: Path) -> None:
    """Read a table, and go on with it."""
    complete.is_evaluated(RunFolder(path.parent), 40)
    last_success(path)
    tables.read(path)
    tables.Appender(path, 81).write({"step": 82, "task": "hard"})


def use_maze(path: Path, seldom: bool) -> None:
    """Read a maze, and sometimes simulate it."""
    declared = registry.own_maze("point", layouts.read(path))
    if seldom:
        declared.factory().reset(seed=0)


def one_of_many(folder: Path) -> Mutate:
    """Return what changes one file of a checkpoint, and now and then its manifest to fit."""
    files_of = sorted(path for path in folder.rglob("*") if path.name != MANIFEST)
    whole = {path: path.read_bytes() for path in files_of}

    def change(chance: random.Random, manifest: bytes) -> bytes:
        for path, content in whole.items():
            if path.read_bytes() != content:
                path.write_bytes(content)
        path = chance.choice(files_of)
        path.write_bytes(of_bytes(chance, whole[path]))
        said = json.loads(manifest)
        if chance.random() < FITTING:
            said["files"][path.relative_to(folder).as_posix()] = files.checksum(path)
        said.pop(files.SEAL)
        return json.dumps(files.sealed(said)).encode()

    return change


def kinds(folder: Path) -> dict[str, Kind]:
    """Return every kind, with whole files in a folder."""
    run, config, spec = whole_run(folder / "run")
    weights = RunFolder(folder / "weights")  # apart: a policy is looked at with its weights whole
    weights.path.mkdir()
    second = RunFolder(shutil.copytree(run.path, folder / "second"))
    configs = []
    for number, configuration in enumerate(configurations()):
        one = RunFolder(folder / f"config-{number}")
        one.create(configuration)
        configs.append(one.config_file.read_bytes())
    parts = networks_of(zeros(config, spec), agents.get(config.agent).networks)
    text, values = either(of_bytes, of_words), either(of_object, of_object, of_words, of_bytes)
    cells = either(of_cells, of_cells, text)
    metrics, evaluation = folder / "metrics.csv", folder / "evaluation.csv"
    toml, yaml, letters = (folder / name for name in ("mine.toml", "mine.yaml", "mine.txt"))

    def in_run(file: Path, mutate: Mutate, use: Callable[[bool], object]) -> Kind:
        return Kind(file, [file.read_bytes()], mutate, use)

    def checkpoint(of: RunFolder, mutate: Mutate) -> Kind:
        found = Checkpoints(of.checkpoints, of.owner(config))
        manifest = of.checkpoints / "40" / MANIFEST
        return in_run(manifest, mutate, lambda seldom: use_checkpoint(found, spec))

    return {
        "config": Kind(
            weights.config_file, configs, values, lambda seldom: use_config(weights, seldom)
        ),
        "policy": in_run(run.policy_config, values, lambda seldom: use_policy(run, seldom)),
        "weights": Kind(
            weights.policy_weights,
            [run.policy_weights.read_bytes()],
            either(of_arrays, of_bytes),
            lambda seldom: load_arrays(weights.policy_weights, parts, {"run": config.identity}),
        ),
        "manifest": checkpoint(run, values),
        "checkpoint": checkpoint(second, one_of_many(second.checkpoints / "40")),
        "metrics": Kind(
            metrics, [table(("critic/loss",))], cells, lambda seldom: use_table(metrics)
        ),
        "evaluation": Kind(
            evaluation,
            [table(("success_rate", "task", "actions"))],
            cells,
            lambda seldom: use_table(evaluation),
        ),
        "preset": Kind(
            toml, [PRESET], text, lambda seldom: presets.resolve("point-u", "sac", str(toml))
        ),
        "yaml": Kind(yaml, [YAML], text, lambda seldom: use_maze(yaml, seldom)),
        "letters": Kind(letters, [LETTERS], text, lambda seldom: use_maze(letters, seldom)),
    }


# --- the run --------------------------------------------------------------------------------------


def mutant(kind: Kind, name: str, number: int, seed: int) -> bytes:
    """Return mutant N of a kind."""
    chance = random.Random(f"{seed} {name} {number}")
    return kind.mutate(chance, chance.choice(kind.whole))


def read_mutants(kind: Kind, name: str, count: int, seed: int) -> Iterator[tuple[int, str]]:
    """Read mutants; yield number and fault of each that neither loads nor is refused."""
    most = most_memory()
    for number in range(count):
        kind.file.unlink(missing_ok=True)
        kind.file.write_bytes(mutant(kind, name, number, seed))
        signal.setitimer(signal.ITIMER_PROF, SECONDS)
        try:
            kind.use(number % SELDOM == 0)
        except ConfigurationError:
            pass
        except Exception as error:
            yield number, described(error)
        finally:
            signal.setitimer(signal.ITIMER_PROF, 0)
        if (now := most_memory()) - most > MEMORY:
            yield number, f"took {(now - most) / 1e6:.0f} MB"
        most = now


def described(error: Exception) -> str:
    """Return an error with the place in midway that raised it last."""
    frames = [f for f in traceback.extract_tb(error.__traceback__) if "midway" in f.filename]
    places = " < ".join(f"{Path(f.filename).name}:{f.lineno}" for f in frames[:-4:-1])
    return f"{type(error).__name__} at {places}: {str(error)[:150]!r}"


def most_memory() -> int:
    """Return the most memory that this process has had (bytes)."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def too_long(number: int, frame: object) -> None:
    """Interrupt what takes too long."""
    raise TimeoutError(f"takes more than {SECONDS} s of processor time")


def main() -> int:
    """Read mutants of every kind, say what was found, and return 1 if anything was."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--each", type=int, default=2_000, help="mutants of each kind")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--kind", help="one kind alone")
    parser.add_argument("--show", type=int, help="write this mutant of --kind, and read none")
    given = parser.parse_args()
    signal.signal(signal.SIGPROF, too_long)
    resource.setrlimit(resource.RLIMIT_AS, (ADDRESSES, resource.RLIM_INFINITY))
    faults = 0
    with tempfile.TemporaryDirectory() as folder:
        for name, kind in kinds(Path(folder)).items():
            if given.kind not in (None, name):
                continue
            if given.show is not None:
                sys.stdout.buffer.write(mutant(kind, name, given.show, given.seed))
                continue
            started, found = time.perf_counter(), {}
            for number, fault in read_mutants(kind, name, given.each, given.seed):
                found.setdefault(fault.partition(": ")[0], []).append((number, fault))
            seconds = time.perf_counter() - started
            print(f"{name}: {given.each} mutants in {seconds:.1f} s, {len(found)} kinds of fault")
            for numbers in found.values():
                print(f"  {len(numbers)} times, first mutant {numbers[0][0]}: {numbers[0][1]}")
            faults += len(found)
    return min(faults, 1)


if __name__ == "__main__":
    sys.exit(main())
