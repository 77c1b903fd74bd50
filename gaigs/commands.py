"""What ``python -m gaigs`` does once the configuration is composed: train, benchmark, agreement, devices."""

import logging
from collections.abc import Mapping, Sequence
from pathlib import Path

from gaigs.configuration import check
from gaigs.processes import limited_threads, only_run
from gaigs.registry import registry

log = logging.getLogger(__name__)


def run(configuration: Mapping, folder: str | Path, overrides: Sequence[str] = ()) -> dict | None:
    """Does the command of a configuration, as ``python -m gaigs`` does; goes on where it was stopped in that folder.

    Args:
        configuration: What ``gaigs.compose`` gives.
        folder: Gets the results; of ``command=train`` the run folder of docs/start.md.
        overrides: Of ``command=benchmark`` alone: words that each of its trainings has, too.

    Returns:
        Of a training the contents of ``metrics.json``, but None in all but the first of several processes; of the other
        commands None.

    Raises:
        TypeError: A value of the configuration is not of its key's type.
        ValueError: The configuration does not fit the data, another run's folder, or a damaged file in this one.
        FileNotFoundError: Data that are not there.
        ImportError: A component needs a package that is not installed.
        OSError: A file cannot be written, e.g. as the disk is full; nothing half-written is left of it.
        KeyboardInterrupt: Ctrl-C, or ``gaigs.processes.Stopped`` for it and SIGTERM.

    Example:
        >>> few = "trainer.max_steps=2", "gaussians.count=20", "trainer.enable_progress_bar=false"
        >>> configuration = gaigs.compose("+experiment=spectrum", "data.transmitters=40", "data.order=0", *few)
        >>> metrics = gaigs.run(configuration, "runs/room")
        Test scores
        ...
        results: runs/room
        >>> list(metrics["models"])
        ['gaigs', 'mean', 'knn', 'gaussian_process']
    """
    if not isinstance(configuration, Mapping):
        raise TypeError(f"configuration must be what gaigs.compose gives, got {configuration!r:.80}")
    config, folder = dict(configuration), Path(folder)
    check(config)
    if config["command"] == "train":
        from gaigs import runs  # slow to import

        return runs.run(config, folder)
    with limited_threads(config["threads"]):
        match config["command"]:
            case "benchmark":
                from gaigs.benchmark import Context, devices  # slow to import

                chosen = registry("benchmark").build(config["benchmark"])
                folder.mkdir(parents=True, exist_ok=True)
                with only_run(folder):
                    chosen.run(folder, Context(tuple(overrides), devices()))
                log.info("results: %s", folder)
            case "agreement":
                from gaigs import agreement  # slow to import

                agreement.run(config, folder)
            case "devices":
                list_devices()
            case unknown:
                raise ValueError(f"command must be train, benchmark, agreement or devices, got {unknown!r}")
    return None


def list_devices() -> None:
    """Prints the OpenCL devices, one a line, and which of them ``rasterizer=opencl`` takes by default.

    Raises:
        ValueError, ImportError, RuntimeError: There is no OpenCL driver, or GAIGS_OPENCL_DEVICE names no device.
    """
    from gaigs.rasterizer import opencl  # slow to import

    names, default = opencl.devices(), opencl.default_device()
    for number, name in enumerate(names):
        print(f"{name}  <- rasterizer=opencl takes this one" if number == names.index(default) else name)
