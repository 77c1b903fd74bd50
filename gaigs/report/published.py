"""Published figures of systems, and displayed names of models."""

from pathlib import Path

import yaml

from gaigs.configuration import conf_dir, plugin_conf_dirs


def read_published() -> dict[str, dict]:
    """The joined contents of ``published.yaml`` of gaigs and of plug-ins.

    ``names`` maps models to displayed names, in the order of the rows. ``scores`` and ``costs``
    have a list of columns for each task; a column has ``title``, ``source``, and ``figures`` by
    model.
    """
    published: dict[str, dict] = {"names": {}, "scores": {}, "costs": {}}
    for folder in (conf_dir(), *plugin_conf_dirs()):
        file = folder / "published.yaml"
        if not file.is_file():
            continue
        try:
            _add(published, file)
        except (AttributeError, KeyError, TypeError, ValueError, yaml.YAMLError) as error:
            raise ValueError(
                f"{file} must have the form of conf/published.yaml: {error!r}"
            ) from error
    return published


def _add(published: dict[str, dict], file: Path) -> None:
    """Adds the content of a file to ``published``."""
    content = yaml.safe_load(file.read_text())
    published["names"].update(content.get("names", {}))
    for part in ("scores", "costs"):
        for task, columns in content.get(part, {}).items():
            for column in columns:
                entries = {key: column[key] for key in ("title", "source", "figures")}
                published[part].setdefault(task, []).append(entries)
