"""Wireless channels predicted with 3-D Gaussian splatting.

>>> model = gaigs.load("runs/room/best.ckpt")
>>> spectra = model.predict([[1.0, 2.0, 1.5]])
>>> gaigs.radio_map(gaigs.load("runs/floor/best.ckpt")).save("floor.npz")
"""

from gaigs.radio_map import radio_map  # at once: imported later, the module of that name would take the place
from gaigs.registry import register, registries

__all__ = ["load", "radio_map", "register", "registries"]


def __getattr__(name: str):
    # torch is heavy: it is imported when something is loaded, not when a component is registered.
    if name == "load":
        from gaigs.checkpoint import load

        return load
    raise AttributeError(f"module 'gaigs' has no attribute {name!r}")
