"""Keys of a configuration: their types, their check, and the options below them."""

from collections.abc import Iterable, Iterator, Mapping

from gaigs.registry import KINDS, check_type, listed, suggest

HARMLESS = (
    "command", "folder", "survey", "place", "locate", "export", "view", "figures",
    "save_every", "tensorboard", "threads", "trust", "trainer.enable_progress_bar",
    "trainer.enable_model_summary",
)  # fmt: skip
"""Keys that change no result: a run may be resumed with other values."""

MAY_BE_NULL = ("gaussians", "density", "projection", "rasterizer")
"""Optional parts."""

KEYS = {
    **dict.fromkeys((*KINDS, "trainer"), dict),
    **dict.fromkeys(MAY_BE_NULL, dict | None),
    "kriging": bool,
    "kriging_fallback": dict | None,
    "baselines": list[dict],
    "command": str,
    "seed": int,
    "ensemble": int,
    "max_time": str | dict | None,
    "save_every": float,
    "tensorboard": bool,
    "threads": int | None,
    "trust": bool,
    "folder": str | None,
    "survey": dict,
    "place": dict,
    "locate": dict,
    "export": dict,
    "view": dict,
    "figures": dict,
}
"""Top-level keys and their types."""


def differences(there: Mapping, here: Mapping, prefix: str = "") -> dict[str, tuple]:
    """Values of two configurations at the keys in which they differ, without ``HARMLESS`` keys.

    Keys are joined by dots and sorted. If the name of a part differs, only the names are compared.
    """
    pairs: dict[str, tuple] = {}
    for key in sorted(there.keys() | here.keys()):
        path = f"{prefix}{key}"
        before = there.get(key)
        after = here.get(key)
        if path in HARMLESS or before == after:
            continue
        if not isinstance(before, dict) or not isinstance(after, dict):
            pairs[path] = before, after
        elif before.get("name") != after.get("name"):
            pairs[f"{path}.name"] = before.get("name"), after.get("name")
        else:
            pairs |= differences(before, after, f"{path}.")
    return pairs


def check(config: dict) -> None:
    """Raises a ``TypeError`` or a ``ValueError`` for a wrong key or value of a configuration."""
    unknown = [key for key in config if key not in KEYS]
    if unknown:
        words = f"{suggest(unknown[0], KEYS)}; it has: {listed(sorted(KEYS))}"
        raise ValueError(f"the configuration has no key {words}")
    missing = sorted(KEYS.keys() - {*MAY_BE_NULL} - config.keys())
    if missing:
        raise ValueError(
            f"the configuration needs the key {missing[0]!r}; conf/config.yaml has them all"
        )
    for key, annotation in KEYS.items():
        check_type(key, config.get(key), annotation)
    for kind in KINDS:
        if config.get(kind) is not None:
            check_type(f"{kind}.name", config[kind].get("name"), str)
    _check_task(config["task"])
    if not 0 <= config["seed"] < 2**32:
        raise ValueError(f"seed must be in 0..{2**32 - 1}, got {config['seed']}")
    if config["save_every"] < 0:
        raise ValueError(f"save_every must be at least 0 s, got {config['save_every']}")


def _check_task(task: dict) -> None:
    """Raises a ``TypeError`` or a ``ValueError`` for a wrong key or value of the task."""
    kinds = {"name": str, "trend": dict | None, "baselines": list[dict | str]}
    for key, value in task.items():
        if key not in kinds:
            raise ValueError(f"task has no key {suggest(key, kinds)}; it has: {', '.join(kinds)}")
        check_type(f"task.{key}", value, kinds[key])


def option_keys(config: Mapping, parts: Iterable[str], prefix: str = "") -> Iterator[str]:
    """Full keys of the options below some keys of a configuration, joined by dots.

    Options that refer to another part with ``${...}`` are left out.

    Args:
        parts: Keys of ``config``.
        prefix: Full key of ``config``, with a dot at its end; empty at the top.
    """
    for part in parts:
        value = config[part]
        # Below the top level only a mapping with a name is a part; others are values of options.
        if isinstance(value, Mapping) and (not prefix or "name" in value):
            yield from option_keys(value, value.keys(), f"{prefix}{part}.")
        elif prefix and not str(value).startswith("${"):
            yield f"{prefix}{part}"
