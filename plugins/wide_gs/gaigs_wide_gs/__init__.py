"""WideGS (Li et al., arXiv 2505.20714): splatting whose networks see the carrier, as
conf/model/wide_gs.yaml has it.
"""

from gaigs.model.gaigs import GaussianSplatting


class WideGs(GaussianSplatting):
    name = "wide_gs"
