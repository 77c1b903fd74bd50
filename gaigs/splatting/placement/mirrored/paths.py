"""The placement of mirrored Gaussians: reflection paths at learnt planes."""

import logging
import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import torch
from jaxtyping import Bool, Complex, Float, Inexact, Int
from scipy.constants import speed_of_light
from torch import Tensor, distributed, nn
from torch.nn import functional

from gaigs.core.antenna import Receiver
from gaigs.core.propagation import NEAREST, fresnel, slab
from gaigs.core.query import Query
from gaigs.core.scene import Scene, carriers
from gaigs.data import Links
from gaigs.registry import register
from gaigs.splatting.gaussians import SH_DC, Gaussians, Placed
from gaigs.splatting.placement import Placement
from gaigs.splatting.placement.mirrored.obstacles import Obstacles
from gaigs.splatting.placement.mirrored.reflections import (
    Folded,
    all_sequences,
    fold,
    images,
    largest_order,
    polarised,
    seen_from,
)
from gaigs.splatting.placement.mirrored.walls import read_planes

log = logging.getLogger(__name__)

BOX = 6
"""Planes at the start: one beyond each face of the box that holds transmitters and receivers, if it
has this side.
"""

MARGIN = 0.04
"""Distance of these planes from the box [diagonals]."""

SMALLER, WIDTH, ENOUGH = 0.85, 0.25, 40
"""Largest area of a turned box over that along the world's axes, its least width over its length,
and fewest places: of 40 that fill a room along the axes chance turns next to none, of 10 a
quarter."""

TILT = 0.05
"""Standard deviation of the random tilt of the first planes: parallel planes would have equal
gradients.
"""

PERMITTIVITY, CONDUCTIVITY = 4.0, 0.3
"""Real and imaginary part of the planes' relative permittivity at the start: between wood and
concrete.
"""

MOST = 100_000
"""Largest number of sequences of planes: of 10 planes those of order 5."""

KNOWN, UNKNOWN = math.log(0.3), math.log(50.0)
"""Logarithm of the standard deviation of a path's phase [rad]: of a known one at the start, and of
a path that adds as power, whose coherence is 0."""

FAINT = 1e-3
"""Largest share of a link's power, obstacles apart, of a path that skips the obstacles: two of
three paths.
"""

UNIT = 0.12
"""Unit of the parameters of plane offsets [diagonals of the box]: learning rates suit rooms of any
size.
"""


@register("placement", "mirrored")
class Mirrored(Placement):
    """Gaussians at p_k = V_k x ~V_k, with the transmitter x and the product V_k of at most
    ``order`` plane vectors.

    In projective geometric algebra a plane is a vector, and its sandwich product mirrors. All paths
    and receivers share the planes, so direction, path length L and spreading follow from geometry.
    Planes, their middles and obstacles are held about the ``middle`` of the room: neither rounding
    nor a turn of a plane depends on the world's origin. The field of path k is

        a_k = F(u_k) / L_k  exp(g_k + g_r + j phi_k + j phi_r - tau_k - j 2 pi L_k / lambda)
              prod_w exp(g_w) Gamma_w(theta)

    with the element's pattern F towards the image, times a learnt power of the cosine; the gain g
    of a path and, except of channels, its phase phi; the gain g_r and, of channels, the phase phi_r
    of a receiver; the gain g_w of a plane, which falls off as a Gaussian about the plane's middle;
    Fresnel's reflection Gamma_w with a learnt permittivity, of channels that of a slab with a
    learnt thickness; and the depth tau_k of the obstacles along the folded path, of channels with a
    phase. Polarisation is vertical: TE at upright planes, TM at level ones, weighted by n_z²
    between. A path that does not meet its planes in their order does not exist.

    Paths add as powers until ``enable_phases``. Channels start from free space until
    ``enable_reflections``.

    Attributes:
        middle: Of the room [m].
        origin: Normals and offsets at the start, or at the last change of ``step`` (w, 4);
            ``shifts`` are added.
        step: Size of a unit of ``shifts``; it follows the wavelength once phases count.
        sequences: Planes of each path, -1 for none (n, order).
        kept, most: Paths that were not dropped (n,), and their number at the start.
        coherent: True once paths interfere.
        is_bare: True while channels have only the direct path; ``planned`` are the paths kept after
            it.
        found: True once planes were searched in channels.
        held, tried: Strengths and offsets within ``holding``.

    Args:
        scene: Its box and receivers give the first planes.
        channels: Of the signal, 1 (amplitude) or 2 (complex).
        planes: Largest number of planes; six at the start; the searches of spectra and channels
            find others.
        order: Largest number of reflections of a path; at most ``MOST`` sequences of planes.
        obstacles: Number of Gaussians of matter in the room; 0 for none.
        walls: File whose largest planes are the first ones: a floor plan ``.csv`` of consecutive
            vertices x,y [m], or a Wavefront ``.obj`` [m]. None: the box's faces. A checkpoint does
            not need the file.
        fixed: True if planes stay at the start.

    Source: ours; Allen and Berkley, Image method for efficiently simulating small-room acoustics,
    1979, for images; Roelfs and De Keninck, Graded Symmetry Groups: Plane and Simple, 2023, for
    reflections as versors.
    """

    sees_receivers = True
    has_own = True
    model = "mirrored"
    learning_rates: Mapping[str, float] = {"planes": 1e-2, "paths": 2e-2, "obstacles": 2.5e-2}
    penalty_weights: Mapping[str, float] = {
        "obstacles": 4e-4
    }  # matter only where paths are attenuated
    middle: Tensor
    origin: Tensor
    step: Tensor
    sequences: Tensor
    kept: Tensor
    most: Tensor
    coherent: Tensor
    is_bare: Tensor
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
        super().__init__()
        for option, value, least in (
            ("planes", planes, BOX),
            ("order", order, 0),
            ("obstacles", obstacles, 0),
        ):
            if value < least:
                raise ValueError(f"placement.{option} must be at least {least}, got {value}")
        if order > (fits := largest_order(planes, MOST)):
            raise ValueError(
                f"placement.order={order} gives more than {MOST:,} sequences of {planes} planes, each with parameters\n"
                f"set placement.order={fits} or less, or fewer placement.planes"
            )
        if channels not in (1, 2):
            raise ValueError(
                f"placement 'mirrored' has 1 or 2 channels, amplitude or complex, got {channels}"
            )
        self.scene, self.channels, self.order = scene, channels, order
        self.walls, self.fixed = walls, fixed
        is_complex = scene.task.dtype.is_complex
        self.box = lower, upper = scene.box
        half = (upper - lower) / 2
        self.register_buffer("middle", lower + half, persistent=False)
        self.diagonal = 2 * float(half.norm())
        margin = MARGIN * self.diagonal
        self.register_buffer("turn", torch.eye(3), persistent=False)
        self.is_new = False  # set by fit
        faces = torch.cat(
            (torch.eye(3), -torch.eye(3), torch.eye(3).repeat(-(-(planes - BOX) // 3), 1))
        )[:planes]
        offsets = torch.cat((half + margin, half + margin, torch.zeros(planes - BOX)))
        normals = faces + TILT * torch.randn(planes, 3)
        self.register_buffer("origin", torch.cat((normals, offsets[:, None]), 1))
        self.register_buffer(
            "first", self.origin.clone(), persistent=False
        )  # a model that differs has learnt
        self.register_buffer("step", torch.ones(()))
        sequences = all_sequences(planes, order)
        self.register_buffer("sequences", sequences, persistent=False)
        # Nothing says how far faces are beyond places that all stand at one height, or on one line.
        unseen = torch.tensor(
            [flat.axis for flat in scene.flat_axes if flat.is_common], dtype=torch.long
        )
        blind = torch.isin(torch.arange(BOX) % 3, unseen).nonzero()[:, 0]
        self.register_buffer(
            "kept", (sequences < BOX).all(1) & ~torch.isin(sequences, blind).any(1)
        )
        self.register_buffer("most", self.kept.sum())
        self.register_buffer("coherent", torch.tensor(False))
        self.register_buffer("is_bare", torch.tensor(False), persistent=is_complex)
        self.register_buffer("found", torch.tensor(False), persistent=is_complex)
        self.register_buffer("planned", self.kept.clone(), persistent=is_complex)

        def filled(value: float, *shape: int) -> nn.Parameter:
            return nn.Parameter(torch.full(shape, value))

        paths, antennas = len(sequences), len(scene.receivers)
        self.shifts = nn.Parameter(torch.zeros(planes, 4), requires_grad=not fixed)
        self.log_permittivities = filled(math.log(PERMITTIVITY - 1), planes)
        self.log_conductivities = filled(math.log(CONDUCTIVITY), planes)
        self.plane_gains = filled(0.0, planes)
        self.middles = filled(0.0, planes, 3)
        self.log_extents = filled(
            math.log(2.0 * self.diagonal), planes, 3
        )  # so wide that planes have no edges
        self.path_gains = filled(0.0, paths)
        # Channels have phases enough to locate planes: a free phase would only hide a plane half a
        # wavelength off.
        self.path_phases = None if is_complex else filled(0.0, paths)
        self.log_thicknesses = (
            filled(0.0, planes) if is_complex else None
        )  # [m]; a metre is a half-space
        self.log_spreads = filled(
            math.log(0.03), paths
        )  # [rad], far below the resolution of small arrays
        self.log_blurs = filled(KNOWN, paths)
        self.receiver_gains, self.directivity = filled(0.0, antennas), filled(0.0)
        self.receiver_phases = filled(0.0, antennas) if is_complex else None
        self.log_bandwidth = None
        if scene.bandwidth != 0 and not is_complex:
            self.log_bandwidth = filled(math.log(scene.bandwidth or speed_of_light / self.diagonal))
        self.obstacles = Obstacles(obstacles, -half, half, is_complex) if obstacles else None
        self.boresights = [torch.tensor([0.0, 0.0, 1.0])] * antennas
        if is_complex:
            self.boresights = [boresight(receiver, self.middle) for receiver in scene.receivers]
        # Of a spectrum even faint paths show: where obstacles block the others.
        self.skips_faint = not is_complex and scene.task.directions is None
        self.holds, self.held, self.tried = False, None, None

    def fit(self, links: Links) -> None:
        """Starts from the user's walls, or turns the faces of the box as the places lie."""
        if self.walls is None:
            self.is_new = torch.equal(self.origin, self.first) and not self.shifts.any()
            places = links.query.transmitters[links.split.train]
            self.turn = upright_turn(places).to(self.origin)
            if self.is_new and not torch.equal(self.turn, torch.eye(3).to(self.turn)):
                faces = torch.cat((self.turn.mT, -self.turn.mT))
                points = torch.cat((places, self.scene.positions(places))).to(self.origin)
                self.origin[:BOX, :3] = self.first[:BOX, :3] @ self.turn.mT
                self.origin[:BOX, 3] = ((points - self.middle) @ faces.mT).amax(
                    0
                ) + MARGIN * self.diagonal
            return
        planes = read_planes(Path(self.walls), *self.box).to(self.origin)
        most = len(self.origin)
        if len(planes) > most:
            log.warning(
                "placement.planes: %s has %d planes, the first %d are taken",
                self.walls,
                len(planes),
                most,
            )
        planes = planes[:most]
        for number, plane in enumerate(planes):
            self.place(number, plane)
        self.kept.copy_(self.sequences_of(torch.arange(len(planes))))
        self.most.copy_(self.kept.sum())

    @property
    def normals(self) -> Float[Tensor, "w 3"]:
        """Unit normals of all planes."""
        return functional.normalize(self.origin[:, :3] + self.step * self.shifts[:, :3], dim=1)

    @property
    def offsets(self) -> Float[Tensor, " w"]:
        """Offsets of all planes along their normals, from the middle of the room [m]."""
        return self.origin[:, 3] + self.step * UNIT * self.diagonal * self.shifts[:, 3]

    @property
    def planes(self) -> Float[Tensor, "w 4"]:
        """Normals and offsets of all planes in the world's frame [m]."""
        return seen_from(torch.cat((self.normals, self.offsets[:, None]), 1).double(), -self.middle)

    @property
    def used(self) -> Int[Tensor, " k"]:
        """Planes of the kept paths."""
        found = self.sequences[self.kept].unique()
        return found[found >= 0]

    @torch.no_grad()
    def place(
        self, number: int, plane: Float[Tensor, "4"], material: Float[Tensor, "3"] | None = None
    ) -> None:
        """Puts one of the ``planes``.

        A material is that of a slab: logarithms of the permittivity's real part over 1, of its
        imaginary part, and of the thickness [m].
        """
        self.origin[number] = seen_from(plane.double(), self.middle)
        self.shifts[number] = 0
        if material is not None:
            (
                self.log_permittivities[number],
                self.log_conductivities[number],
                self.log_thicknesses[number],
            ) = material

    def sequences_of(self, planes: Int[Tensor, " k"]) -> Bool[Tensor, " n"]:
        """True for each sequence of these planes alone."""
        planes = torch.cat((planes, planes.new_tensor([-1]))).to(self.sequences.device)
        return torch.isin(self.sequences, planes).all(1)

    @torch.no_grad()
    def enable_phases(self, wavelength: float) -> None:
        """Lets paths interfere, and planes move in fractions of the wavelength [m]."""
        self.origin.copy_(torch.cat((self.normals, self.offsets[:, None]), 1))
        self.shifts.zero_()
        # 2.2 wavelengths: a usual step of 0.01 then turns a phase by a tenth of a radian.
        self.step.fill_(min(1.0, 2.2 * wavelength / (UNIT * self.diagonal)))
        self.coherent.fill_(True)

    @property
    def located(self) -> Bool[Tensor, " w"]:
        """True for planes at which paths interfere."""
        known = (self.sequences >= 0).sum(1) <= 1
        known &= self.log_blurs < (KNOWN + UNKNOWN) / 2
        return torch.isin(
            torch.arange(len(self.origin), device=known.device), self.sequences[known]
        )

    @torch.no_grad()
    def locate(self, *planes: int) -> None:
        """Lets paths at these planes and at others that are ``located`` interfere; all others add
        as powers.
        """
        located = self.located if planes else self.located & False
        located[list(planes)] = True
        phased = self.sequences_of(located.nonzero()[:, 0])
        self.path_phases[phased & (self.log_blurs > (KNOWN + UNKNOWN) / 2)] = 0
        self.log_blurs.copy_(torch.where(phased, self.log_blurs.clamp_max(KNOWN), UNKNOWN))

    @torch.no_grad()
    def start_from_free_space(self, gains: Complex[Tensor, " receivers"]) -> None:
        """Keeps only the direct path, without obstacles and spread; gains are over the pooling's
        unit, not 0.
        """
        self.planned.copy_(self.kept)
        self.kept.copy_(self.sequences_of(self.used[:0]))
        self.is_bare.fill_(True)
        self.receiver_gains.copy_(gains.abs().log())
        self.receiver_phases.copy_(gains.angle())

    @torch.no_grad()
    def enable_reflections(self) -> None:
        """Ends ``start_from_free_space``."""
        self.kept.copy_(self.planned)
        self.is_bare.fill_(False)

    @contextmanager
    def holding(self) -> Iterator[None]:
        """Keeps the first query's strengths within the context, while images follow the planes.

        The strengths are in ``held``. Offsets of the planes for each transmitter (b, w) [m] may be
        set as ``tried``.
        """
        self.holds = True
        try:
            yield
        finally:
            self.holds, self.held, self.tried = False, None, None

    def forward(self, gaussians: Gaussians | None, query: Query) -> Placed:
        """Gaussians at the images of each transmitter, followed by the free ones."""
        sequences = self.sequences[self.kept]
        normals, offsets = self.normals, self.offsets if self.tried is None else self.tried
        seen = images(query.transmitters - self.middle, sequences, normals, offsets)
        receivers = (self.scene.positions(query.transmitters) - self.middle)[query.receivers]
        lengths = (seen[-1] - receivers[:, None]).norm(dim=-1).clamp_min(NEAREST)
        strengths = self.held
        if strengths is None:
            strengths = self.strengths(query, fold(seen, receivers, sequences, normals, offsets))
            strengths = strengths * self._patterns(query, seen[-1] - receivers[:, None])
            if self.holds:
                self.held = strengths
        gains = strengths / lengths
        coherences = torch.zeros_like(self.log_blurs[self.kept])
        if self.coherent:
            turns = lengths / (speed_of_light / carriers(self.scene, query).to(lengths))[:, None]
            phases = -2 * math.pi * (turns - turns.detach().round())
            if self.path_phases is not None:
                phases = phases + self.path_phases[self.kept]
            if self.receiver_phases is not None:
                phases = phases + self.receiver_phases[query.receivers, None]
            gains = gains * torch.polar(torch.ones_like(phases), phases)
            coherences = (-self.log_blurs[self.kept].exp().square() / 2).exp()
        if distributed.is_available() and distributed.is_initialized():
            # Each process waits for the gradients of all parameters, also of unused ones.
            gains = gains + 0 * sum(
                parameter.sum() for parameter in self.parameters() if parameter.requires_grad
            )
        signal = lengths.new_zeros(len(sequences), self.channels, 1)
        signal[:, 0] = 1
        scales = (lengths * (self.log_spreads[self.kept].exp() * ~self.is_bare))[..., None].expand(
            -1, -1, 3
        )
        quats = signal.new_tensor([1.0, 0, 0, 0]).expand(len(sequences), 4)
        bandwidth = None if self.log_bandwidth is None else self.log_bandwidth.exp()
        ones = signal.new_ones(len(sequences))
        placed = Placed(
            seen[-1] + self.middle,
            lengths,
            quats,
            scales,
            ones,
            signal,
            gains,
            coherences,
            bandwidth,
        )
        return placed if gaussians is None else _beside(placed, gaussians)

    def folded(
        self, query: Query
    ) -> tuple[list[Float[Tensor, "b n 3"]], Float[Tensor, "b 3"], Folded]:
        """Images of the kept paths, their receivers, and the paths through the room; from its
        middle [m].
        """
        sequences, normals, offsets = self.sequences[self.kept], self.normals, self.offsets
        seen = images(query.transmitters - self.middle, sequences, normals, offsets)
        receivers = (self.scene.positions(normals) - self.middle)[query.receivers]
        return seen, receivers, fold(seen, receivers, sequences, normals, offsets)

    def strengths(
        self, query: Query, folded: Folded, blocked: bool = True
    ) -> Complex[Tensor, "b n"]:
        """Field of each kept path over free space, after reflections and obstacles; 0 for no path."""
        left = self.path_gains[self.kept] + self.receiver_gains[query.receivers, None]
        left = torch.complex(left.exp() * folded.exists, torch.zeros_like(left))
        left = folded.reflected(left, self.coefficients(query, folded))
        if blocked and self.obstacles is not None and not self.is_bare:
            left = left * (-self._depths(self.obstacles, folded, left)).exp()
        return left

    def coefficients(self, query: Query, folded: Folded) -> Complex[Tensor, "b w"]:
        """Reflection coefficients at the bounces, with the gains of their planes."""
        planes, cosines = folded.planes, folded.cosines
        permittivities = torch.complex(
            1 + self.log_permittivities.exp(), -self.log_conductivities.exp()
        )[planes]
        if self.log_thicknesses is None:
            te, tm = fresnel(permittivities, cosines)
        else:
            wavelengths = speed_of_light / carriers(self.scene, query).to(cosines)[:, None]
            te, tm = slab(permittivities, cosines, self.log_thicknesses[planes].exp() / wavelengths)
        aside = (folded.bounces - self.middles[planes]) * (-self.log_extents[planes]).exp()
        gains = (self.plane_gains[planes] - aside.square().sum(-1) / 2).exp()
        return polarised(folded.normals, te, tm) * gains

    def _depths(
        self, obstacles: Obstacles, folded: Folded, strengths: Complex[Tensor, "b n"]
    ) -> Inexact[Tensor, "b n"]:
        """Depth of each path through the obstacles; 0 for no path and, of levels, for a ``FAINT``
        one.
        """
        depths = torch.zeros_like(strengths.real if obstacles.turns is None else strengths)
        with torch.no_grad():
            heard = strengths != 0
            if self.skips_faint:
                spans = (folded.end - folded.start).norm(dim=-1)
                lengths = depths.real.index_add(1, folded.path, spans).clamp_min(NEAREST)
                powers = (strengths.abs() / lengths).square()
                heard = powers > FAINT * powers.sum(1, keepdim=True)
            legs = heard[:, folded.path].flatten().nonzero()[:, 0]
        ends = (end.flatten(0, 1).index_select(0, legs) for end in (folded.start, folded.end))
        count, n = strengths.shape
        paths = folded.path + n * torch.arange(count, device=legs.device)[:, None]
        return depths.flatten().index_add(0, paths.flatten()[legs], obstacles(*ends)).view(count, n)

    def passing(self, query: Query) -> Float[Tensor, "b v"]:
        """Field over free space of the direct path, then of that at each plane; 0 for no path."""
        sequences, strengths = (
            self.sequences[self.kept],
            self.strengths(query, self.folded(query)[2]).abs(),
        )
        few = (sequences >= 0).sum(1) <= 1
        found = strengths.new_zeros(len(query), len(self.origin) + 1)
        found[:, sequences[few].amax(1) + 1] = strengths[:, few]
        return found / self.receiver_gains[query.receivers, None].exp()

    def margins(self, query: Query) -> Complex[Tensor, "b n"]:
        """Standard deviation of each kept path's field over free space before any residual is
        known, with its phase.

        It is the path's own field times the share that obstacles block, and a tenth of the field
        without obstacles.
        """
        seen, receivers, folded = self.folded(query)
        own, free = self.strengths(query, folded), self.strengths(query, folded, blocked=False)
        share = 1 - own.abs() / free.abs().clamp_min(torch.finfo(own.real.dtype).tiny)
        return (share * own + 0.1 * free) * self._patterns(query, seen[-1] - receivers[:, None])

    def pattern(self, receiver: int, directions: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b"]:
        """Field gain of a receiver's elements in its frame; of arrays times the learnt cos^q."""
        array = self.scene.receivers[receiver].array
        gain = array.gain(directions)
        normal = self.boresights[receiver]
        if len(array) == 1 or not normal.any():
            return gain
        cosines = (directions @ normal.to(directions)).clamp_min(
            0.05
        )  # the logarithm has no bound at 0
        return gain * cosines**self.directivity

    def _patterns(self, query: Query, ways: Float[Tensor, "b n 3"]) -> Float[Tensor, "b n"]:
        """Field gain of the receivers' elements towards points, ``ways`` from the receivers [m]."""
        gains = torch.ones_like(ways[..., 0])
        for receiver in query.receivers.unique().tolist():
            if self.scene.receivers[receiver].array.is_point:
                continue
            own, rotation = (
                query.receivers == receiver,
                self.scene.receivers[receiver].pose.rotation.to(ways),
            )
            gains[own] = self.pattern(receiver, functional.normalize(ways[own] @ rotation, dim=-1))
        return gains

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """Positions of planes; other parameters of planes, paths and receivers; obstacles."""
        obstacles = [] if self.obstacles is None else [*self.obstacles.parameters()]
        apart = {id(parameter) for parameter in (self.shifts, *obstacles)}
        groups = {} if self.fixed else {"planes": [self.shifts]}
        groups["paths"] = [
            parameter for parameter in self.parameters() if id(parameter) not in apart
        ]
        return groups | ({"obstacles": obstacles} if obstacles else {})

    def penalties(self) -> dict[str, Float[Tensor, ""]]:
        """The obstacles' mean density over a diagonal of the room [Np]."""
        if self.obstacles is None:
            return {}
        return {"obstacles": self.obstacles.densities.mean() * self.diagonal}


def boresight(receiver: Receiver, middle: Float[Tensor, "3"]) -> Float[Tensor, "3"]:
    """Normal of a planar array in its own frame, towards a point of the world [m]; 0 for other
    arrays.
    """
    elements = receiver.array.elements.double()
    _, values, axes = torch.linalg.svd(elements - elements.mean(0), full_matrices=True)
    flat = 1e-6 * values[0]  # float32 places elements no better
    if len(values) < 3 or values[2] > flat or values[1] <= flat:
        return torch.zeros(3)
    normal = axes[2].float()
    return normal if normal @ receiver.pose.to(middle).local(middle) >= 0 else -normal


def _beside(placed: Placed, gaussians: Gaussians) -> Placed:
    """Mirrored Gaussians followed by free ones, whose path lengths and phases are unknown."""
    b, free = len(placed.lengths), len(gaussians)
    ones = placed.lengths.new_ones(b, free)
    return Placed(
        means=torch.cat((placed.means, gaussians.means.expand(b, -1, -1)), 1),
        lengths=torch.cat((placed.lengths, 0 * ones), 1),
        quats=torch.cat((placed.quats, gaussians.unit_quats)),
        scales=torch.cat((placed.scales, gaussians.scales.expand(b, -1, -1)), 1),
        opacities=torch.cat((placed.opacities, gaussians.opacities)),
        signal=torch.cat((placed.signal, gaussians.signal)),
        gains=torch.cat((placed.gains, torch.complex(SH_DC * ones, 0 * ones)), 1),
        coherences=torch.cat((placed.coherences, ones.new_zeros(free))),
        bandwidth=placed.bandwidth,
    )


def upright_turn(places: Float[Tensor, "n 3"]) -> Float[Tensor, "3 3"]:
    """Rotation about z to the axes of the upright box that holds all places and has the least area.

    The box along the world's axes is kept unless the other is clearly smaller, and no strip: places
    along a line say nothing of the room's walls, nor do fewer than ``ENOUGH``.
    """
    turn = torch.eye(3, dtype=torch.float64)
    if len(places.unique(dim=0)) < ENOUGH:
        return turn.to(places)
    angles = torch.arange(0, 90, dtype=torch.float64).deg2rad()
    cos, sin = angles.cos(), angles.sin()
    axes = torch.stack((torch.stack((cos, -sin), 1), torch.stack((sin, cos), 1)), 1)  # columns
    along = places[:, :2].double() @ axes
    edges = along.amax(1) - along.amin(1)
    areas = edges.prod(1)
    best = int(areas.argmin())
    if areas[best] < SMALLER * areas[0] and edges[best].min() > WIDTH * edges[best].max():
        turn[:2, :2] = axes[best]
    return turn.to(places)
