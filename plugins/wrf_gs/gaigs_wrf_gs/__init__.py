"""WRF-GS (INFOCOM 2025): splatting with the two-stage network of NeRF², as conf/model/wrf_gs.yaml
has it.
"""

from gaigs.model.gaigs import GaussianSplatting


class WrfGs(GaussianSplatting):
    name = "wrf_gs"
