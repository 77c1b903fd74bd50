"""WRF-GS+ (IEEE TWC 2025): splatting with a wave for each transmitter, as
conf/model/wrf_gs_plus.yaml has it.
"""

from gaigs.model.gaigs import GaussianSplatting


class WrfGsPlus(GaussianSplatting):
    name = "wrf_gs_plus"
