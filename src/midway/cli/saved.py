"""Commands that take a trained policy elsewhere."""

from pathlib import Path

from tyro.conf import Positional

from midway.errors import ConfigurationError


def export(
    run: Positional[Path], onnx: bool = False, numpy: bool = False, out: Path | None = None
) -> None:
    """Write a trained policy for programs without JAX, and say how far it is off.

    Args:
        run: Run folder.
        onnx: As an ONNX model, policy.onnx.
        numpy: As a Python module that needs NumPy alone, policy.py with policy.npz.
        out: Folder of the files; default: export in the run folder.
    """
    from midway.runs import export as exports
    from midway.runs import export_onnx
    from midway.runs import policy as policies
    from midway.runs.folder import RunFolder

    if not (onnx or numpy):
        raise ConfigurationError("export: give --onnx, --numpy or both")
    policy = policies.load(RunFolder(run))
    folder = out or run / "export"
    folder.mkdir(parents=True, exist_ok=True)
    written = {}
    if numpy:
        written[folder / "policy.py"] = exports.write_numpy(policy, folder / "policy.py")
    if onnx:
        written[folder / "policy.onnx"] = export_onnx.write_onnx(policy, folder / "policy.onnx")
    for path, act in written.items():
        print(f"{path}: actions within {exports.check(policy, act):.0e} of the policy's")


def push(run: Positional[Path], repository: Positional[str], private: bool = False) -> None:
    """Share a run's policy, settings and numbers on the Hugging Face hub.

    Args:
        run: Run folder.
        repository: USER/NAME; it is made if it is not there.
        private: Whether a new one is private.
    """
    from midway.runs import hub

    print(hub.push(run, repository, private))


def pull(repository: Positional[str], out: Path | None = None) -> None:
    """Fetch a run that was shared on the Hugging Face hub.

    Args:
        repository: USER/NAME.
        out: Folder of the run; default: runs/NAME.
    """
    from midway.runs import hub

    print(hub.pull(repository, out))
