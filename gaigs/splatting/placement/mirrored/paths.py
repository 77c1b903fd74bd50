"""The placement of mirrored Gaussians: reflection paths at learnt planes."""

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

import torch
from jaxtyping import Bool, Complex, Float, Int
from scipy.constants import speed_of_light
from torch import Tensor, distributed, nn

from gaigs.core.propagation import NEAREST
from gaigs.core.query import Query
from gaigs.core.scene import Scene, carriers
from gaigs.registry import register
from gaigs.splatting.gaussians import SH_DC, Gaussians, Placed
from gaigs.splatting.placement.mirrored.path_fields import PathFields
from gaigs.splatting.placement.mirrored.reflections import fold, images


@register("placement", "mirrored")
class Mirrored(PathFields):
    """Gaussians at the images p_k = V_k x ~V_k of the transmitter x in up to ``order`` planes.

    V_k is the product of a sequence of planes. In projective geometric algebra a plane is a vector,
    and the sandwich product with it is a reflection. All paths and receivers share the planes, so
    direction, path length and spreading follow from geometry. ``PathFields`` computes the fields.

    Powers of paths add until ``enable_phases``. Channels start from free space until
    ``enable_reflections``.

    Attributes:
        coherent: True once paths interfere.
        is_bare: True while channels have only the direct path.
        planned: True for paths that will be in use after ``enable_reflections`` (n,).
        found: True once a search has found the planes.
        held: Path strengths of the first query, reused within ``holding``.
        tried: Trial offsets, which replace the planes' offsets within ``holding``.

    Args:
        scene: Its box and receivers give the first planes.
        channels: Channels of the signal, 1 (amplitude) or 2 (complex).
        planes: Largest number of planes. The first six are the box's faces; searches in spectra and
            channels find others.
        order: Largest number of reflections of a path; at most 100,000 sequences of planes.
        obstacles: Number of Gaussians of matter in the room; 0 also disables the search for boxes.
        walls: File whose largest planes are the first ones: a floor plan ``.csv`` of consecutive
            vertices x,y [m], or a Wavefront ``.obj`` [m]. None: the faces of the box. A checkpoint
            does not need the file.
        fixed: True if planes are not trained.

    Source: ours; Allen and Berkley, Image method for efficiently simulating small-room acoustics,
    1979, for images; Roelfs and De Keninck, Graded Symmetry Groups: Plane and Simple, 2023, for
    reflections as versors.
    """

    sees_receivers = True
    has_own = True
    model = "mirrored"
    learning_rates: Mapping[str, float] = {"planes": 1e-2, "paths": 2e-2, "obstacles": 2.5e-2}
    # Matter only where paths are attenuated.
    penalty_weights: Mapping[str, float] = {"obstacles": 4e-4}
    coherent: Tensor
    found: Tensor
    planned: Tensor

    def __init__(
        self,
        scene: Scene,
        channels: int,
        planes: int = 10,
        order: int = 2,
        obstacles: int = 60,
        walls: str | None = None,
        fixed: bool = False,
    ):
        if channels not in (1, 2):
            raise ValueError(
                f"placement 'mirrored' has 1 or 2 channels, amplitude or complex, got {channels}"
            )
        super().__init__(scene, planes, order, obstacles, walls, fixed)
        self.channels = channels
        self.register_buffer("coherent", torch.tensor(False))
        # Checkpoints of amplitudes lack the states of these stages, which only channels have.
        self.register_buffer("is_bare", torch.tensor(False), persistent=self.is_complex)
        self.register_buffer("found", torch.tensor(False), persistent=self.is_complex)
        self.register_buffer("planned", self.kept.clone(), persistent=self.is_complex)
        self.holds = False
        self.held = None
        self.tried = None

    # --- stages of a training ---

    @torch.no_grad()
    def enable_phases(self, wavelength: float) -> None:
        """Makes paths interfere, and planes move in fractions of the wavelength [m]."""
        self.move_by_wavelengths(wavelength)
        self.coherent.fill_(True)

    @property
    def _is_blurred(self) -> Bool[Tensor, " n"]:
        """True for paths whose powers add."""
        return self.log_blurs > (self.known_blur + self.unknown_blur) / 2

    @property
    def located(self) -> Bool[Tensor, " w"]:
        """True for planes whose single reflection interferes with other paths."""
        is_single = (self.sequences >= 0).sum(1) <= 1  # or the direct path
        interferes = is_single & ~self._is_blurred
        numbers = torch.arange(len(self.origin), device=interferes.device)
        return torch.isin(numbers, self.sequences[interferes])

    @torch.no_grad()
    def locate(self, *planes: int) -> None:
        """Marks planes as located, in addition to those that are, by their numbers.

        Paths without other planes than located ones interfere. Powers of all other paths add.
        Without an argument no plane is located any longer, and only the direct path has a phase.
        """
        located = self.located if planes else torch.zeros_like(self.located)
        located[list(planes)] = True
        interferes = self.sequences_of(located.nonzero()[:, 0])  # (n,)
        self.path_phases[interferes & self._is_blurred] = 0  # no phase was learnt so far
        known = self.log_blurs.clamp_max(self.known_blur)
        self.log_blurs.copy_(torch.where(interferes, known, self.unknown_blur))

    @torch.no_grad()
    def start_from_free_space(self, gains: Complex[Tensor, " receivers"]) -> None:
        """Reduces the model to the direct path, without obstacles and angular spread.

        ``enable_reflections`` restores the other paths. ``gains`` are the complex gains of the
        receivers, in the pooling's unit; all differ from 0.
        """
        self.planned.copy_(self.kept)
        no_planes = self.used[:0]
        self.kept.copy_(self.sequences_of(no_planes))
        self.is_bare.fill_(True)
        self.receiver_gains.copy_(gains.abs().log())
        self.receiver_phases.copy_(gains.angle())

    @torch.no_grad()
    def start_strengths(
        self,
        gains: Complex[Tensor, "bands w"],
        receivers: Int[Tensor, " r"],
        receiver_gains: Complex[Tensor, " r"],
    ) -> None:
        """Sets gain and phase of each path to the product of the gains of the path's planes.

        Args:
            gains: Complex gains of the first w planes in each of ``bands``. They multiply the
                reflection coefficients of the planes' slabs. Further planes have a gain of 1.
            receivers: Numbers of the receivers.
            receiver_gains: Gains of these receivers, in the pooling's unit.
        """
        least = 1e-3  # a logarithm needs some gain
        # The last column is for -1, which stands for no plane in a sequence.
        ones = gains.new_ones(len(gains), len(self.origin) + 1 - gains.shape[1])
        plane_gains = torch.cat((gains, ones), 1)  # (bands, planes + 1)
        factors = plane_gains[:, self.sequences]  # (bands, n, order)
        strengths = factors.abs().clamp_min(least).log().sum(2)  # (bands, n)
        self.path_gains.copy_(strengths.view_as(self.path_gains))
        if self.path_phases is not None:
            self.path_phases.copy_(factors.angle().sum(2).view_as(self.path_phases))
        self.receiver_gains[receivers] = receiver_gains.abs().clamp_min(least).log().float()
        if self.receiver_phases is not None:
            self.receiver_phases[receivers] = receiver_gains.angle().float()

    @torch.no_grad()
    def enable_reflections(self) -> None:
        """Restores the paths that ``start_from_free_space`` removed."""
        self.kept.copy_(self.planned)
        self.is_bare.fill_(False)

    @contextmanager
    def holding(self) -> Iterator[None]:
        """A context in which path strengths stay constant while planes are moved.

        ``held`` has the strengths of the first query. ``tried`` may have offsets of the planes for
        each transmitter (b, w) [m].
        """
        self.holds = True
        try:
            yield
        finally:
            self.holds = False
            self.held = None
            self.tried = None

    # --- paths ---

    def forward(self, gaussians: Gaussians | None, query: Query) -> Placed:
        """Gaussians at the images of each transmitter, followed by the trainable ``gaussians``."""
        sequences = self.sequences[self.kept]  # (n, order)
        normals = self.normals
        offsets = self.offsets if self.tried is None else self.tried
        seen = images(query.transmitters - self.middle, sequences, normals, offsets)
        receivers = (self.scene.positions(query.transmitters) - self.middle)[query.receivers]
        ways = seen[-1] - receivers[:, None]  # from receivers to the last images (b, n, 3) [m]
        lengths = ways.norm(dim=-1).clamp_min(NEAREST)
        strengths = self.held
        if strengths is None:
            folded = fold(seen, receivers, sequences, normals, offsets)
            strengths = self.strengths(query, folded) * self.patterns(query, ways)
            if self.holds:
                self.held = strengths
        gains = strengths / lengths
        coherences = torch.zeros_like(self.log_blurs[self.kept])
        if self.coherent:
            gains = gains * self._phasors(query, lengths)
            # A normal error of the phase leaves exp(-variance / 2) of the field.
            coherences = (-self.log_blurs[self.kept].exp().square() / 2).exp()
        if distributed.is_available() and distributed.is_initialized():
            # Each process waits for the gradients of all parameters, also of unused ones.
            gains = gains + 0 * sum(
                parameter.sum() for parameter in self.parameters() if parameter.requires_grad
            )
        placed = self._placed(seen[-1] + self.middle, lengths, gains, coherences)
        return placed if gaussians is None else _beside(placed, gaussians)

    def _phasors(self, query: Query, lengths: Float[Tensor, "b n"]) -> Complex[Tensor, "b n"]:
        """Phase factors of paths by their lengths [m], learnt phases, and the receivers' phases."""
        wavelengths = speed_of_light / carriers(self.scene, query).to(lengths)  # (b,)
        turns = lengths / wavelengths[:, None]
        # Whole turns are removed, since float32 rounds large phases.
        phases = -2 * math.pi * (turns - turns.detach().round())
        if self.path_phases is not None:
            phases = phases + self.of_bands(self.path_phases, query)[..., self.kept]
        if self.receiver_phases is not None:
            phases = phases + self.gains_at(query.receivers).imag[:, None]
        return torch.polar(torch.ones_like(phases), phases)

    def _placed(
        self,
        means: Float[Tensor, "b n 3"],
        lengths: Float[Tensor, "b n"],
        gains: Complex[Tensor, "b n"],
        coherences: Float[Tensor, " n"],
    ) -> Placed:
        """Round Gaussians at the images ``means``, with widths of angular spread times path length.

        ``gains`` are the complex fields of the paths, ``coherences`` the shares with a known phase.
        """
        count = lengths.shape[1]
        signal = lengths.new_zeros(count, self.channels, 1)
        signal[:, 0] = 1  # real 1, which the complex gain multiplies
        widths = lengths * (self.log_spreads[self.kept].exp() * ~self.is_bare)
        return Placed(
            means=means,
            lengths=lengths,
            quats=signal.new_tensor([1.0, 0, 0, 0]).expand(count, 4),
            scales=widths[..., None].expand(-1, -1, 3),
            opacities=signal.new_ones(count),
            signal=signal,
            gains=gains,
            coherences=coherences,
            bandwidth=None if self.log_bandwidth is None else self.log_bandwidth.exp(),
        )

    # --- training ---

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """Parameters by groups.

        Groups are positions of planes; parameters of planes, paths and receivers; and obstacles.
        """
        obstacles = [] if self.obstacles is None else [*self.obstacles.parameters()]
        in_other_groups = {id(parameter) for parameter in (self.shifts, *obstacles)}
        groups = {} if self.fixed else {"planes": [self.shifts]}
        groups["paths"] = [
            parameter for parameter in self.parameters() if id(parameter) not in in_other_groups
        ]
        if obstacles:
            groups["obstacles"] = obstacles
        return groups

    def penalties(self) -> dict[str, Float[Tensor, ""]]:
        """The obstacles' mean density times the diagonal of the room [Np]."""
        if self.obstacles is None:
            return {}
        return {"obstacles": self.obstacles.densities.mean() * self.diagonal}


def _beside(placed: Placed, gaussians: Gaussians) -> Placed:
    """Mirrored Gaussians followed by trainable ones, of unknown path lengths and phases."""
    b = len(placed.lengths)
    free = len(gaussians)
    ones = placed.lengths.new_ones(b, free)
    return Placed(
        means=torch.cat((placed.means, gaussians.means.expand(b, -1, -1)), 1),
        lengths=torch.cat((placed.lengths, 0 * ones), 1),
        quats=torch.cat((placed.quats, gaussians.unit_quats)),
        scales=torch.cat((placed.scales, gaussians.scales.expand(b, -1, -1)), 1),
        opacities=torch.cat((placed.opacities, gaussians.opacities)),
        signal=torch.cat((placed.signal, gaussians.signal)),
        # The signal of trainable Gaussians is a coefficient of the constant harmonic.
        gains=torch.cat((placed.gains, torch.complex(SH_DC * ones, 0 * ones)), 1),
        coherences=torch.cat((placed.coherences, ones.new_zeros(free))),
        bandwidth=placed.bandwidth,
    )
