"""A small splatting pipeline, whose parts tests exchange."""

import torch

EUCLIDEAN = {"gaussian_octaves": (-3, 2), "transmitter_octaves": (-2, 4), "hidden": 16, "width": 8}
PARTS = {
    "placement": {"name": "free"},
    "tokenizer": {
        "name": "multiview",
        "ga": {"name": "ga"},
        "euclidean": {"name": "euclidean", **EUCLIDEAN},
    },
    "projection": {"name": "mercator"},
    "rasterizer": {"name": "torch"},
    "pooling": {"name": "spectrum", "channels": 2},
    "gaussians": {
        "count": 40,
        "near": 2.0,
        "far": 5.0,
        "spread": 1.0,
        "opacity": 0.1,
        "signal": 1.0,
    },
}
ALL = ["rotation", "scale", "signal", "opacity", "attenuation"]
NONE = {"deformation": {"name": "none"}}
SOFTMAX = {"name": "softmax_attention", "grid": [4, 8], "temperature": 0.3, "prior": 0.2}
MEAN_POWER = {"name": "mean_power", "grid": [4, 8], "channels": 2, "floor_db": -60.0}


def two_branch(heads):
    return {
        "name": "two_branch",
        "width": 16,
        "attenuation_layers": 1,
        "signal_layers": 1,
        "heads": heads,
    }


def trained(model):
    """The model as after some training: Gaussians of many shapes, heads that answer."""
    with torch.no_grad():
        model.gaussians.log_scales.add_(0.5 * torch.randn(40, 3))
        for head in getattr(model.deformation, "heads", {}).values():
            head.weight.normal_(std=0.1)
    return model


def watch(model, calls):
    """Has the rasterizer's arguments kept."""
    rasterizer = model.rasterizer

    def rasterize(*arguments):
        calls.append(arguments)
        return rasterizer(*arguments)

    model.rasterizer = rasterize
