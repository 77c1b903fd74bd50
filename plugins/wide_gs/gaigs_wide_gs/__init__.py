"""WideGS: splatting whose networks see the carrier."""

from gaigs.model.gaigs import GaussianSplatting


class WideGs(GaussianSplatting):
    """The splatting pipeline under the name of its results; ``conf/model/wide_gs.yaml`` has the parts.

    Args:
        As for ``GaussianSplatting``.

    Source: WideGS (Li et al., arXiv 2505.20714).
    """

    name = "wide_gs"
