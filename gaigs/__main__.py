"""The command line: ``python -m gaigs +experiment=spectrum``."""

import logging
import sys
from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from hydra.errors import CompactHydraException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from gaigs import configuration
from gaigs.registry import check_type


def run(config: DictConfig) -> None:
    """Does the task of a configuration.

    Raises:
        CompactHydraException: There is no such task, or it fails for a reason that a user can mend.
    """
    match config.get("task"):  # None where it is missing
        case "train":
            train(config)
        case "devices":
            list_devices()
        case unknown:
            raise CompactHydraException(f"gaigs: task must be train or devices, got {unknown!r}")


def train(config: DictConfig) -> None:
    """Runs one configuration in Hydra's run folder.

    Raises:
        CompactHydraException: What a user can mend, as one message; Hydra prints it without the traceback and exits
            with 1, after the other jobs of a multirun.
    """
    try:
        plain = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
        for key, annotation in {"seed": int, "save_every": float, "tensorboard": bool}.items():
            check_type(key, plain.get(key), annotation)
    except OmegaConfBaseException as error:  # whose message Hydra adds
        raise CompactHydraException("gaigs: the configuration is not complete") from error
    except TypeError as error:
        raise CompactHydraException(f"gaigs: {error}") from error
    # Slow to import: here, once the configuration has proved good.
    from lightning.pytorch.utilities.exceptions import MisconfigurationException

    from gaigs import experiment

    for name in ("lightning.pytorch", "lightning.fabric"):  # which set their levels when they are imported
        logging.getLogger(name).setLevel(logging.WARNING)
    settings = HydraConfig.get()
    try:
        experiment.run(plain, Path(settings.runtime.output_dir))
    except KeyboardInterrupt as stop:
        mode = "sweep" if settings.mode is RunMode.MULTIRUN else "run"
        folder = f"hydra.{mode}.dir={settings[mode].dir}"
        print(f"gaigs: {str(stop) or 'stopped'}; the same command with {folder} goes on", file=sys.stderr)
        raise SystemExit(130) from None  # as shells report Ctrl-C
    except (ValueError, TypeError, OSError, ImportError, RuntimeError, MisconfigurationException) as error:
        raise CompactHydraException(f"gaigs: {error}") from error


def list_devices() -> None:
    """Prints the OpenCL devices, one a line, and which of them ``rasterizer=opencl`` takes by default.

    Raises:
        CompactHydraException: There is no OpenCL driver, or GAIGS_OPENCL_DEVICE names no device.
    """
    try:
        from gaigs.rasterizer import opencl  # slow to import

        names, default = opencl.devices(), opencl.default_device()
    except (ValueError, ImportError, RuntimeError) as error:
        raise CompactHydraException(f"gaigs: {error}") from error
    for number, name in enumerate(names):
        print(f"{name}  <- rasterizer=opencl takes this one" if number == names.index(default) else name)


def main() -> None:
    """The console script ``gaigs``."""
    configuration.install()
    hydra.main(version_base="1.3", config_path=str(configuration.conf_dir()), config_name="config")(run)()


if __name__ == "__main__":
    sys.exit(main())
