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


def run(config: DictConfig) -> None:
    """Runs one configuration in Hydra's run folder.

    Raises:
        CompactHydraException: What a user can mend, as one message; Hydra prints it without the traceback and exits
            with 1, after the other jobs of a multirun.
    """
    try:
        plain = OmegaConf.to_container(config, resolve=True, throw_on_missing=True)
    except OmegaConfBaseException as error:  # whose message Hydra adds
        raise CompactHydraException("gaigs: the configuration is not complete") from error
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


def main() -> None:
    """The console script ``gaigs``."""
    configuration.install()
    hydra.main(version_base="1.3", config_path=str(configuration.conf_dir()), config_name="config")(run)()


if __name__ == "__main__":
    sys.exit(main())
