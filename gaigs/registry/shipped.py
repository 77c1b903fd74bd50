"""Plug-ins in the repository, for errors if they are not installed."""

PACKAGES = {
    "array_response": ("array_response",),
    "deepmimo": ("deepmimo", "deepmimo_rssi"),
    "gsrf": ("gsrf", "mean_amplitude"),
    "nerf2": ("nerf2",),
    "nerf_apt": ("nerf_apt",),
    "networks": ("mlp", "fire", "dcgan", "wrf_kan", "adversarial"),
    "newrf": ("newrf",),
    "ngrf": ("ngrf",),
    "ray_tracing": ("ray_tracing",),
    "rf_3dgs": ("rf_3dgs",),
    "sionna": ("sionna", "sionna_csi", "sionna_rssi"),
    "swift_wrf": ("swift_wrf",),
    "wide_gs": ("wide_gs",),
    "wrf_gs": ("wrf_gs", "two_stage", "clamped"),
    "wrf_gs_plus": ("wrf_gs_plus", "amplitude_phase"),
}
"""Registered names by folder of ``plugins``."""


def not_installed(kind: str, name: str) -> str | None:
    """The error for a component of a plug-in that is not installed; None for any other name."""
    for folder, names in PACKAGES.items():
        if name in names:
            package = f"gaigs-{folder.replace('_', '-')}"
            return (
                f"{kind} {name!r} is in the package {package}, which is not installed\n"
                f"pip install {package}, or in a copy of the repository pip install "
                f"./plugins/{folder}"
            )
    return None
