"""WRF-GS+: splatting with a static signal, to which a deformation adds a wave for each transmitter."""

from gaigs.model.gaigs import GaussianSplatting


class WrfGsPlus(GaussianSplatting):
    """The splatting pipeline under the name of its results; ``conf/model/wrf_gs_plus.yaml`` has the parts.

    Args:
        As for ``GaussianSplatting``.

    Source: WRF-GS+ (IEEE TWC 2025).
    """

    name = "wrf_gs_plus"
