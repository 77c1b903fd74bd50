"""The command line: ``python -m gaigs +experiment=spectrum``."""

import logging
import sys
import warnings
from pathlib import Path

import hydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from gaigs import configuration

log = logging.getLogger("gaigs")


def run(config: DictConfig) -> None:
    """Runs one configuration in Hydra's run folder."""
    folder = Path(HydraConfig.get().runtime.output_dir)
    OmegaConf.resolve(config)
    OmegaConf.save(config, folder / "config.yaml")
    from gaigs import experiment  # torch and Lightning load once the configuration has proved good

    try:
        experiment.run(OmegaConf.to_container(config), folder)
    except (ValueError, TypeError, FileNotFoundError, ImportError, RuntimeError) as error:
        if log.isEnabledFor(logging.DEBUG):
            raise
        # What a user can mend is one line; the traceback is in the log of hydra.verbose=true.
        raise SystemExit(f"gaigs: {error}") from None


def main() -> None:
    """The console script ``gaigs``."""
    # Hydra writes into the run folder before Lightning looks whether it is empty; the others are advice on what we do not do.
    for message in (".*exists and is not empty", ".*LeafSpec", ".*does not have many workers"):
        warnings.filterwarnings("ignore", message)
    configuration.install()
    hydra.main(version_base="1.3", config_path=str(configuration.conf_dir()), config_name="config")(run)()


if __name__ == "__main__":
    sys.exit(main())
