"""WRF-GS: splatting whose Gaussians send what NeRF²'s two-stage network says."""

from gaigs.model.gaigs import GaussianSplatting


class WrfGs(GaussianSplatting):
    """The splatting pipeline under the name of its results; ``conf/model/wrf_gs.yaml`` has the parts.

    Args:
        As for ``GaussianSplatting``.

    Source: WRF-GS (INFOCOM 2025).
    """

    name = "wrf_gs"
