"""Mirrored Gaussians: each stands at an image of the transmitter in planes that are learnt, the walls of the room."""

import logging
import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import torch
from jaxtyping import Bool, Complex, Float, Int
from scipy.constants import speed_of_light
from torch import Tensor, distributed, nn
from torch.nn import functional

from gaigs.algebra import PROJECTIVE
from gaigs.algebra.embedding import embed_reflection, embed_scalar
from gaigs.data import Links
from gaigs.gaussians import SH_DC, Gaussians
from gaigs.placement import Placed, Placement
from gaigs.placement.mirrored.obstacles import Obstacles
from gaigs.placement.mirrored.reflections import Folded, all_words, fold, images
from gaigs.placement.mirrored.walls import read_planes
from gaigs.propagation import NEAREST, carriers, fresnel
from gaigs.query import Query
from gaigs.registry import register
from gaigs.scene import Receiver, Scene

log = logging.getLogger(__name__)

BOX = 6
"""Planes at the start: one beyond each face of the box that holds transmitters and receivers."""

MARGIN = 0.04
"""How far beyond, in diagonals of that box."""

TILT = 0.05
"""Standard deviation of the normals' random start: planes that are exactly parallel would have the same gradients."""

PERMITTIVITY, CONDUCTIVITY = 4.0, 0.3
"""Real and imaginary part of the planes' relative permittivity at the start: between wood and concrete."""

EXTENT = 2.0
"""Standard deviation of a plane's window at the start, in diagonals of the box: at first planes have no edges."""

SPREAD = 0.03
"""Angular standard deviation of a Gaussian at the start [rad]: far below what arrays of some elements resolve."""

BLUR = 0.3
"""Standard deviation of a path's phase once phases are looked at [rad]; it follows the data."""

UNIT = 0.12
"""What a step of 1 in a plane's offset is, in diagonals of the box, so that learning rates suit rooms of any size."""

FLAT = 1e-6
"""Least extent of an array over its largest, by which it is no line, or no plane: float32 places it no better."""

FINE = 2.2
"""What it is once phases count [wavelengths]: a usual step of 0.01 then turns a phase by a tenth of a radian."""

GRAZING = 0.05
"""Smallest cosine off the array's normal that the learnt pattern tells from 0, where its logarithm has no bound."""


@register("placement", "mirrored")
class Mirrored(Placement):
    """Gaussians at p_k = V_k x ~V_k, x the transmitter and V_k the product of at most ``order`` planes' vectors.

    In projective geometric algebra a plane is a vector, and its sandwich product mirrors. Planes are shared by all
    paths and receivers, so direction, path length L and spreading follow from geometry. The field of path k is

        a_k = F(u_k) / L_k  exp(g_k + g_r + j phi_k + j phi_r - tau_k - j 2 pi L_k / lambda)
              prod_w exp(g_w) Gamma_w(theta)

    with F the element's pattern towards the image, times a learnt power of the cosine; g and phi a path's own gain and
    phase, g_r a receiver's gain and of channels phi_r its phase, g_w a plane's, which falls off as a Gaussian about the
    plane's middle; Gamma_w Fresnel's reflection with a learnt permittivity; and tau_k the optical depth of the
    obstacles along the folded path.
    Polarisation is taken as vertical: TE at upright planes, TM at level ones, by n_z² in between. A path that does not
    meet its planes in their order does not exist.

    Phases are not looked at before ``coherent`` is set (see ``sharpen``): powers alone say where planes are to some
    centimetres, and phases take a fraction of the wavelength.

    For channels there is a phase of each receiver, too, and the start is free space: while ``is_bare`` is set there is
    the direct path alone, without obstacles and spread (see ``furnish``).

    Args:
        scene: Its box and receivers say where the first planes are.
        channels: Of the signal, 1 (amplitude) or 2 (complex).
        planes: How many there may be; six at the start, the others are found (``gaigs.model.mirrored``).
        order: Largest number of reflections of a path.
        obstacles: Gaussians of matter in the room; 0 for none.
        walls: File of walls to start from: a floor plan ``.csv`` of consecutive vertices x,y [m], or a Wavefront
            ``.obj`` [m], of which the largest planes are taken; None: the box's faces. A checkpoint does not need it.
        fixed: Whether planes stay where they start.

    Raises:
        ValueError: An option is out of range.

    Source: ours; Allen and Berkley, Image method for efficiently simulating small-room acoustics, 1979, for images;
    Roelfs and De Keninck, Graded Symmetry Groups: Plane and Simple, 2023, for reflections as versors.
    """

    sees_receivers = True
    has_own = True
    model = "mirrored"

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
        if planes < BOX:
            raise ValueError(f"placement.planes must be at least {BOX}, one for each face of a box, got {planes}")
        if order < 0:
            raise ValueError(f"placement.order must be at least 0 reflections, got {order}")
        if obstacles < 0:
            raise ValueError(f"placement.obstacles must be at least 0, got {obstacles}")
        if channels not in (1, 2):
            raise ValueError(f"placement 'mirrored' has 1 or 2 channels, amplitude or complex, got {channels}")
        self.scene, self.channels, self.order = scene, channels, order
        receivers = scene.positions(scene.lower)
        lower = torch.cat((scene.lower[None], receivers)).amin(0)
        upper = torch.cat((scene.upper[None], receivers)).amax(0)
        self.box = lower, upper
        self.diagonal = float((upper - lower).norm())
        margin = MARGIN * self.diagonal
        faces = torch.cat((torch.eye(3), -torch.eye(3), torch.eye(3).repeat(-(-(planes - BOX) // 3), 1)))[:planes]
        offsets = torch.cat((upper + margin, margin - lower, torch.zeros(planes - BOX)))
        # Planes turn about a point within a diagonal of the box, wherever the world's origin is; 0 where that is near.
        self.register_buffer("pivot", ((lower + upper) / (2 * self.diagonal)).trunc() * self.diagonal)
        normals = faces + TILT * torch.randn(planes, 3)
        offsets = offsets + (functional.normalize(normals, dim=1) - faces) @ self.pivot
        self.register_buffer("origin", torch.cat((normals, offsets[:, None]), 1))
        self.register_buffer("step", torch.ones(()))
        self.walls, self.fixed = walls, fixed
        self.shifts = nn.Parameter(torch.zeros(planes, 4), requires_grad=not fixed)
        self.log_permittivities = nn.Parameter(torch.full((planes,), math.log(PERMITTIVITY - 1)))
        self.log_conductivities = nn.Parameter(torch.full((planes,), math.log(CONDUCTIVITY)))
        self.plane_gains = nn.Parameter(torch.zeros(planes))
        self.middles = nn.Parameter(((lower + upper) / 2).repeat(planes, 1))
        self.log_extents = nn.Parameter(torch.full((planes, 3), math.log(EXTENT * self.diagonal)))
        words = all_words(planes, order)
        self.register_buffer("words", words, persistent=False)
        self.path_gains = nn.Parameter(torch.zeros(len(words)))
        self.path_phases = nn.Parameter(torch.zeros(len(words)))
        self.receiver_gains = nn.Parameter(torch.zeros(len(scene.receivers)))
        self.directivity = nn.Parameter(torch.zeros(()))
        self.log_spreads = nn.Parameter(torch.full((len(words),), math.log(SPREAD)))
        self.log_blurs = nn.Parameter(torch.full((len(words),), math.log(BLUR)))
        self.register_buffer("kept", ((words < BOX).all(1)))
        self.register_buffer("most", self.kept.sum())
        self.register_buffer("coherent", torch.tensor(False))
        self.log_bandwidth = None
        if scene.bandwidth != 0 and not scene.task.dtype.is_complex:
            bandwidth = scene.bandwidth or speed_of_light / self.diagonal
            self.log_bandwidth = nn.Parameter(torch.tensor(math.log(bandwidth)))
        self.obstacles = Obstacles(obstacles, lower, upper) if obstacles else None
        is_complex = scene.task.dtype.is_complex
        self.register_buffer("is_bare", torch.tensor(False), persistent=is_complex)
        self.register_buffer("planned", self.kept.clone(), persistent=is_complex)
        self.boresights = [torch.tensor([0.0, 0.0, 1.0])] * len(scene.receivers)
        self.receiver_phases = None
        if is_complex:
            self.boresights = [boresight(receiver, (lower + upper) / 2) for receiver in scene.receivers]
            self.receiver_phases = nn.Parameter(torch.zeros(len(scene.receivers)))
        self.holds, self.held = False, None

    def fit(self, links: Links) -> None:
        """Starts from the user's walls, where there are any.

        Raises:
            FileNotFoundError: There is no such file.
            ValueError: It holds no planes.
        """
        if self.walls is None:
            return
        planes = read_planes(Path(self.walls), *self.box).to(self.origin)
        most = len(self.origin)
        if len(planes) > most:
            log.warning(
                "%s has %d planes, of which the first %d are taken: placement.planes", self.walls, len(planes), most
            )
        planes = planes[:most]
        for plane, (*normal, offset) in enumerate(planes):
            self.place(plane, torch.stack(normal), offset.item())
        self.kept.copy_(self.words_of(torch.arange(len(planes), device=self.kept.device)))

    def _load_from_state_dict(self, state_dict, prefix, *args):
        """Planes of earlier checkpoints, which have no pivot, turn about the world's origin; their channels have no
        phase of a receiver, and are furnished."""
        state_dict.setdefault(f"{prefix}pivot", torch.zeros_like(self.pivot))
        if self.receiver_phases is not None:
            state_dict.setdefault(f"{prefix}receiver_phases", torch.zeros_like(self.receiver_phases))
            state_dict.setdefault(f"{prefix}is_bare", torch.zeros_like(self.is_bare))
            state_dict.setdefault(f"{prefix}planned", torch.zeros_like(self.planned))
        super()._load_from_state_dict(state_dict, prefix, *args)

    # --- the room ---

    @property
    def normals(self) -> Float[Tensor, "w 3"]:
        """Of all planes, of unit length."""
        return functional.normalize(self.origin[:, :3] + self.step * self.shifts[:, :3], dim=1)

    @property
    def offsets(self) -> Float[Tensor, "w"]:
        """Of all planes along their normals, from the world's origin [m]."""
        moved = self.origin[:, 3] + self.step * UNIT * self.diagonal * self.shifts[:, 3]
        return moved + (self.normals - functional.normalize(self.origin[:, :3], dim=1)) @ self.pivot

    @property
    def used(self) -> Int[Tensor, "k"]:
        """Planes that a kept path meets."""
        found = self.words[self.kept].unique()
        return found[found >= 0]

    @property
    def versors(self) -> Float[Tensor, "n 16"]:
        """V_k of the kept paths in projective geometric algebra."""
        planes = embed_reflection(self.normals, self.offsets)
        versors = embed_scalar(planes.new_ones(int(self.kept.sum())))
        for column in self.words[self.kept].unbind(1):
            moved = PROJECTIVE.product(planes[column], versors)
            versors = torch.where(column[:, None] >= 0, moved, versors)
        return versors

    @torch.no_grad()
    def place(self, plane: int, normal: Float[Tensor, "3"], offset: float) -> None:
        """Puts a plane elsewhere; its offset is in [m]."""
        self.origin[plane] = torch.cat((functional.normalize(normal, dim=0), normal.new_tensor([offset])))
        self.shifts[plane] = 0

    def words_of(self, planes: Int[Tensor, "k"]) -> Bool[Tensor, "n"]:
        """The words of these planes alone."""
        return torch.isin(self.words, torch.cat((planes, planes.new_tensor([-1])))).all(1)

    @torch.no_grad()
    def sharpen(self, wavelength: float) -> None:
        """From now on paths interfere, and planes move in fractions of the wavelength [m]."""
        self.origin.copy_(torch.cat((self.normals, self.offsets[:, None]), 1))
        self.shifts.zero_()
        self.step.fill_(min(1.0, FINE * wavelength / (UNIT * self.diagonal)))
        self.coherent.fill_(True)

    @torch.no_grad()
    def strip(self, gains: Complex[Tensor, "receivers"]) -> None:
        """Starts channels from free space, with a gain of each receiver over the pooling's unit, none of them 0."""
        self.planned.copy_(self.kept)
        self.kept.copy_(self.words_of(self.used[:0]))
        self.is_bare.fill_(True)
        self.receiver_gains.copy_(gains.abs().log())
        self.receiver_phases.copy_(gains.angle())

    @torch.no_grad()
    def furnish(self) -> None:
        """Ends ``strip``: from now on planes reflect, obstacles dim and paths spread."""
        self.kept.copy_(self.planned)
        self.is_bare.fill_(False)

    @contextmanager
    def holding(self) -> Iterator[None]:
        """Within it, strengths stay those of the first query, while images follow the planes: for searches."""
        self.holds = True
        try:
            yield
        finally:
            self.holds, self.held = False, None

    # --- the Gaussians of a query ---

    def forward(self, gaussians: Gaussians | None, query: Query) -> Placed:
        """Gaussians at the images of each transmitter, and the free ones behind them."""
        words = self.words[self.kept]
        normals, offsets = self.normals, self.offsets
        seen = images(query.transmitters, words, normals, offsets)
        receivers = self.scene.positions(query.transmitters)[query.receivers]
        lengths = (seen[-1] - receivers[:, None]).norm(dim=-1).clamp_min(NEAREST)
        strengths = self.held
        if strengths is None:
            strengths = self.strengths(query, fold(seen, receivers, words, normals, offsets))
            strengths = strengths * self._patterns(query, seen[-1])
            if self.holds:
                self.held = strengths
        gains = strengths / lengths
        coherences = torch.zeros_like(self.log_blurs[self.kept])
        if self.coherent:
            turns = lengths / (speed_of_light / carriers(self.scene, query).to(lengths))[:, None]
            phases = self.path_phases[self.kept] - 2 * math.pi * (turns - turns.detach().round())
            if self.receiver_phases is not None:
                phases = phases + self.receiver_phases[query.receivers, None]
            gains = gains * torch.polar(torch.ones_like(phases), phases)
            coherences = (-self.log_blurs[self.kept].exp().square() / 2).exp()
        if distributed.is_available() and distributed.is_initialized():
            # Of several processes each waits for the gradients of all parameters, also of those not in use yet.
            gains = gains + 0 * sum(parameter.sum() for parameter in self.parameters() if parameter.requires_grad)
        signal = lengths.new_zeros(len(words), self.channels, 1)
        signal[:, 0] = 1
        scales = (lengths * (self.log_spreads[self.kept].exp() * ~self.is_bare))[..., None].expand(-1, -1, 3)
        quats = signal.new_tensor([1.0, 0, 0, 0]).expand(len(words), 4)
        bandwidth = None if self.log_bandwidth is None else self.log_bandwidth.exp()
        ones = signal.new_ones(len(words))
        placed = Placed(seen[-1], lengths, quats, scales, ones, signal, gains, coherences, bandwidth)
        return placed if gaussians is None else _beside(placed, gaussians)

    def strengths(self, query: Query, folded: Folded) -> Complex[Tensor, "b n"]:
        """What reflections and obstacles leave of each kept path's field, over free space; 0 where there is no path."""
        left = self.path_gains[self.kept] + self.receiver_gains[query.receivers, None]
        if self.obstacles is not None and not self.is_bare:
            left = left.index_add(1, folded.path, -self.obstacles(folded.start, folded.end))
        left = torch.complex(left.exp() * folded.exists, torch.zeros_like(left))
        normals = self.normals
        permittivities = torch.complex(1 + self.log_permittivities.exp(), -self.log_conductivities.exp())
        for first, planes, points, cosines in folded.bounces:
            te, tm = fresnel(permittivities[planes], cosines)
            level = normals[planes, 2].square()
            aside = (points - self.middles[planes]) * (-self.log_extents[planes]).exp()
            reflected = ((1 - level) * te + level * tm) * (self.plane_gains[planes] - aside.square().sum(-1) / 2).exp()
            left = torch.cat((left[:, :first], left[:, first:] * reflected), 1)
        return left

    def pattern(self, receiver: int, directions: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b"]:
        """Field gain of a receiver's elements in its frame; of an array also what was learnt, cos^q."""
        array = self.scene.receivers[receiver].array
        gain = array.gain(directions)
        normal = self.boresights[receiver]
        if len(array) == 1 or not normal.any():
            return gain
        return gain * (directions @ normal.to(directions)).clamp_min(GRAZING) ** self.directivity

    def _patterns(self, query: Query, points: Float[Tensor, "b n 3"]) -> Float[Tensor, "b n"]:
        """Field gain of the receivers' elements towards points."""
        gains = torch.ones_like(points[..., 0])
        for receiver in query.receivers.unique().tolist():
            own, pose = query.receivers == receiver, self.scene.receivers[receiver].pose.to(points)
            gains[own] = self.pattern(receiver, functional.normalize(pose.local(points[own]), dim=-1))
        return gains

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """Planes, what is learnt of each plane and path, and obstacles."""
        groups = {} if self.fixed else {"planes": [self.shifts]}
        groups["paths"] = [
            self.log_permittivities, self.log_conductivities, self.plane_gains, self.middles, self.log_extents,
            self.path_gains, self.path_phases, self.log_spreads, self.log_blurs, self.receiver_gains, self.directivity,
        ]  # fmt: skip
        groups["paths"] += [part for part in (self.log_bandwidth, self.receiver_phases) if part is not None]
        if self.obstacles is not None:
            groups["obstacles"] = list(self.obstacles.parameters())
        return groups

    def penalties(self) -> dict[str, Float[Tensor, ""]]:
        """The obstacles' mean density over a diagonal of the room [Np]."""
        if self.obstacles is None:
            return {}
        return {"obstacles": self.obstacles.densities.mean() * self.diagonal}


def boresight(receiver: Receiver, middle: Float[Tensor, "3"]) -> Float[Tensor, "3"]:
    """The normal of a planar array in its own frame, on the side of a point of the world [m]; of others 0: no axis."""
    elements = receiver.array.elements.double()
    _, values, axes = torch.linalg.svd(elements - elements.mean(0), full_matrices=True)
    if len(values) < 3 or values[2] > FLAT * values[0] or values[1] <= FLAT * values[0]:
        return torch.zeros(3)
    normal = axes[2].float()
    return normal if normal @ receiver.pose.to(middle).local(middle) >= 0 else -normal


def _beside(placed: Placed, gaussians: Gaussians) -> Placed:
    """Mirrored Gaussians and free ones behind them, whose paths' lengths and so phases are unknown."""
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
