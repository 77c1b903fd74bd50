"""The commands of ``python -m gaigs``: options, tables, files and figures of each."""

import importlib
from collections.abc import Mapping
from pathlib import Path

from gaigs import processes
from gaigs.configuration import check
from gaigs.core import stages
from gaigs.registry import call, suggest
from gaigs.registry.torch_modes import usual_modes
from gaigs.report.formats import figure_formats

COMMANDS = ("agreement", "describe", "survey", "place", "locate", "export", "view")
"""Commands beside the training, each a module of its name."""


def run(configuration: Mapping, folder: str | Path, launcher: str | None = None) -> dict | None:
    """Executes the command of a configuration, as ``python -m gaigs`` does.

    An interrupted run in the same folder is resumed.

    Args:
        configuration: The result of ``gaigs.compose``.
        folder: Folder of the results; with ``command=train`` the run folder of docs/start.md.
        launcher: Class name of Hydra's launcher in a job of a multirun; None otherwise.

    Returns:
        With ``command=train`` the contents of ``metrics.json``; None in all other commands, and in
        all but the first of several processes.

    Raises:
        TypeError, ValueError: The configuration does not fit the data, or the folder holds another
            run.
        ImportError: A component needs a package that is not installed.
        OSError: A file cannot be read or written; no partial file is left.
        KeyboardInterrupt: Ctrl-C. Within a training Ctrl-C, SIGTERM and SIGHUP raise its subclass
            ``gaigs.processes.Stopped``.

    Example:
        >>> words = "model=knn", "data.transmitters=40", "data.order=0"
        >>> configuration = gaigs.compose(*words, baselines=["mean"])
        >>> metrics = gaigs.run(configuration, "runs/room")
        Test scores
        ...
        results: runs/room
        >>> list(metrics["models"])
        ['knn', 'mean']
    """
    if not isinstance(configuration, Mapping):
        raise TypeError(
            f"configuration must be the result of gaigs.compose, got {configuration!r:.80}"
        )
    config, folder = dict(configuration), Path(folder)
    if config.get("command") == "devices":  # works with any other keys
        _list_devices()
        return None
    check(config)
    with call("figures", figure_formats, config["figures"]):
        _check_command(config["command"])
        return _execute(config, folder, launcher)


def _list_devices() -> None:
    """Prints the devices of OpenCL."""
    from gaigs.splatting.rasterizer.devices import default_device, devices

    names = devices()
    default = default_device()
    for number, name in enumerate(names):
        is_default = number == names.index(default)  # the first of that name
        print(f"{name}  <- rasterizer=opencl takes this one" if is_default else name)


def _check_command(command: str) -> None:
    """Raises a ``ValueError`` for an unknown command."""
    scripts = {
        "report": "python -m gaigs.report FOLDER makes its tables",
        "benchmark": "python benchmarks/step.py and others measure, in a clone",
    }
    if command in scripts:
        raise ValueError(f"there is no command {command!r}; {scripts[command]}")
    known = ("train", *COMMANDS, "devices")
    if command not in known:
        words = ", ".join(known)
        raise ValueError(f"command must be one of {words}, got {suggest(command, known)}")


@usual_modes()
def _execute(config: dict, folder: Path, launcher: str | None) -> dict | None:
    """Executes the command of a configuration whose keys and command are checked already."""
    command = config["command"]
    if config["folder"] is not None and command in ("train", "describe", "agreement"):
        remedy = "hydra.run.dir=..." if command == "train" else "data=... and split=..."
        raise ValueError(f"command={command} reads no folder; leave it out and use {remedy}")
    if command == "train":
        from gaigs import runs

        return runs.run(config, folder, launcher)
    if config["folder"] is None and command in ("place", "locate", "export", "view"):
        source = "the folder of a finished run"
        if command == "view":
            source += ", or a checkpoint"
        raise ValueError(f"command={command} needs {source}; add folder=runs/...")
    module = importlib.import_module(f"gaigs.commands.{command}")
    with processes.limited_threads(config["threads"]):
        if command == "view":
            module.run(config)
            return None
        shows = config["trainer"].get("enable_progress_bar", True)
        with stages.watched(shown=shows):
            module.run(config, folder)
    return None
