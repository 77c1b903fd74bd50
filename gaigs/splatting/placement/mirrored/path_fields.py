"""Fields of reflection paths at learnt planes, after materials, obstacles and element patterns."""

import math
from typing import NamedTuple

import torch
from jaxtyping import Complex, Float, Inexact, Int
from scipy.constants import speed_of_light
from torch import Tensor, nn
from torch.nn import functional

from gaigs.core.antenna import Receiver
from gaigs.core.propagation import NEAREST, fresnel, slab
from gaigs.core.query import Query
from gaigs.core.scene import Scene, carriers
from gaigs.data import Links
from gaigs.splatting.placement.mirrored.movable_planes import MovablePlanes
from gaigs.splatting.placement.mirrored.obstacles import Obstacles
from gaigs.splatting.placement.mirrored.reflections import Folded, fold, images, polarised


class FoldedLinks(NamedTuple):
    """Links with their paths in a room; positions are relative to the room's middle [m]."""

    seen: list[Float[Tensor, "b n 3"]]  # images of the transmitters, see ``reflections.images``
    receivers: Float[Tensor, "b 3"]  # position of each link's receiver
    paths: Folded  # through the room

    @property
    def ways(self) -> Float[Tensor, "b n 3"]:
        """Vectors from the receivers to the last images [m]: directions and lengths of paths."""
        return self.seen[-1] - self.receivers[:, None]


class PathFields(MovablePlanes):
    """Fields of paths with learnt materials, gains and obstacles.

    The field of path k of length L is

        a_k = F(u_k) / L_k  exp(g_k + g_r + j phi_k + j phi_r - tau_k - j 2 pi L_k / lambda)
              prod_w exp(g_w) Gamma_w(theta)

    with

    * F: the element's pattern towards the image, times a learnt power of the cosine;
    * g_k, phi_k: gain and phase of a path, in each band of the receivers; phi_k is 0 for channels
      with many values;
    * g_r, phi_r: gain and phase of a receiver; phi_r is 0 unless labels are channels;
    * g_w: the gain of a plane, which falls with the distance from its middle as a Gaussian;
    * Gamma_w: Fresnel's reflection with a learnt permittivity; for channels that of a slab with a
      learnt thickness. Polarisation is vertical: TE at upright planes, TM at level ones, weighted
      by n_z² between;
    * tau_k: the depth of the obstacles along the folded path; complex for channels.

    A path that does not meet its planes in their order does not exist.

    Attributes:
        is_complex: True for channels.
        bands: Different bands of the receivers [Hz].
        is_bare: True while channels have only the direct path, without obstacles.
        is_heard: True for receivers with training links (r,); others have ``_common_gain``.
        known_blur: Logarithm of the initial standard deviation [rad] of the phase of a path that
            interferes.
        unknown_blur: The same logarithm for a path that adds as power, whose coherence is 0.
        faint: Largest share of a link's power, without obstacles, for which the obstacles of a path
            are not computed. That saves two of three paths.
        fewest_numbers: Number of channel values (elements times subcarriers) below which a few
            paths explain any channel, so that only all places together locate planes.
    """

    known_blur = math.log(0.3)
    unknown_blur = math.log(50.0)
    faint = 1e-3
    fewest_numbers = 8
    is_bare: Tensor
    is_heard: Tensor

    def __init__(
        self,
        scene: Scene,
        planes: int,
        order: int,
        obstacles: int,
        walls: str | None,
        fixed: bool,
    ):
        super().__init__(scene, planes, order, walls, fixed)
        self._check_number("obstacles", obstacles, 0)
        self.is_complex = scene.task.dtype.is_complex
        self.bands = sorted({receiver.band for receiver in scene.receivers})
        self._number_bands()
        numbers = math.prod(scene.task.shape) // len(self.bands)
        self.has_few_numbers = self.is_complex and numbers < self.fewest_numbers
        self._add_plane_parameters(planes)
        self._add_path_parameters(planes)
        self._add_receiver_parameters()
        half = (self.box[1] - self.box[0]) / 2
        self.obstacles = Obstacles(obstacles, -half, half, self.is_complex) if obstacles else None
        # Spectra show even faint paths, where obstacles block the others.
        self.skips_faint = not self.is_complex and scene.task.directions is None

    def _add_plane_parameters(self, planes: int) -> None:
        """Adds permittivities, gains and reflecting areas."""
        # Between wood and concrete: a relative permittivity of 4 - 0.3j.
        self.log_permittivities = _filled(math.log(3.0), planes)
        self.log_conductivities = _filled(math.log(0.3), planes)
        self.plane_gains = _filled(0.0, planes)
        self.middles = _filled(0.0, planes, 3)
        # So wide that planes have no edges.
        self.log_extents = _filled(math.log(2.0 * self.diagonal), planes, 3)

    def _add_path_parameters(self, planes: int) -> None:
        """Adds gains and phases, slabs, angular spreads, and coherences (``log_blurs``)."""
        paths = len(self.sequences)
        strengths = (len(self.bands), paths) if len(self.bands) > 1 else (paths,)
        self.path_gains = _filled(0.0, *strengths)
        # Channels of many numbers locate planes by their phases: a free phase would only hide a
        # plane half a wavelength off.
        is_free = not self.is_complex or self.has_few_numbers
        self.path_phases = _filled(0.0, *strengths) if is_free else None
        # [m]; a metre is a half-space.
        self.log_thicknesses = _filled(0.0, planes) if self.is_complex else None
        # [rad], far below the resolution of small arrays.
        self.log_spreads = _filled(math.log(0.03), paths)
        self.log_blurs = _filled(self.known_blur, paths)

    def _add_receiver_parameters(self) -> None:
        """Adds gains and phases of receivers, directivity, and bandwidth."""
        radios = self.scene.radios
        self.receiver_gains = _filled(0.0, radios)
        self.directivity = _filled(0.0)
        self.receiver_phases = _filled(0.0, radios) if self.is_complex else None
        self.register_buffer("is_heard", torch.ones(radios, dtype=torch.bool))
        bandwidth = self.scene.bandwidth
        self.log_bandwidth = None
        if bandwidth != 0 and not self.is_complex:
            self.log_bandwidth = _filled(math.log(bandwidth or speed_of_light / self.diagonal))
        self.boresights = self._boresights()

    def _boresights(self) -> list[Tensor]:
        """``boresight`` of each receiver for channels; the z axis for powers and spectra."""
        receivers = self.scene.receivers
        if not self.is_complex:
            return [torch.tensor([0.0, 0.0, 1.0])] * len(receivers)
        return [boresight(receiver, self.middle) for receiver in receivers]

    def _load_from_state_dict(self, state_dict, prefix, *args):
        # Receivers without training links had gains of their own before.
        state_dict.setdefault(prefix + "is_heard", torch.ones_like(self.is_heard))
        if self.path_phases is not None:  # channels with few values had none before
            state_dict.setdefault(prefix + "path_phases", torch.zeros_like(self.path_phases))
        super()._load_from_state_dict(state_dict, prefix, *args)

    @torch.no_grad()
    def place(
        self, number: int, plane: Float[Tensor, "4"], material: Float[Tensor, "3"] | None = None
    ) -> None:
        """Replaces plane ``number`` by ``plane`` in the world's frame, and its slab if given.

        ``material`` has logarithms of the permittivity's real part minus 1, of its imaginary part,
        and of the thickness [m].
        """
        super().place(number, plane)
        if material is not None:
            self.log_permittivities[number] = material[0]
            self.log_conductivities[number] = material[1]
            self.log_thicknesses[number] = material[2]

    def folded(self, query: Query) -> FoldedLinks:
        """The kept paths of links, folded through the room."""
        sequences = self.sequences[self.kept]
        normals = self.normals
        offsets = self.offsets
        seen = images(query.transmitters - self.middle, sequences, normals, offsets)
        receivers = (self.scene.positions(normals) - self.middle)[query.receivers]
        paths = fold(seen, receivers, sequences, normals, offsets)
        return FoldedLinks(seen, receivers, paths)

    def strengths(
        self, query: Query, folded: Folded, blocked: bool = True
    ) -> Complex[Tensor, "b n"]:
        """Field of each kept path, relative to free space over the same length.

        Phases of paths and receivers are not included. The field of a path that does not exist is
        0. With ``blocked`` False obstacles are left out.
        """
        path_gains = self.of_bands(self.path_gains, query)
        # g_k + g_r, logarithms of gains (b, n).
        gains = path_gains[..., self.kept] + self.gains_at(query.receivers).real[:, None]
        fields = torch.complex(gains.exp() * folded.exists, torch.zeros_like(gains))
        fields = folded.reflected(fields, self.coefficients(query, folded))
        if blocked and self.obstacles is not None and not self.is_bare:
            fields = fields * (-self._depths(self.obstacles, folded, fields)).exp()
        return fields

    def coefficients(self, query: Query, folded: Folded) -> Complex[Tensor, "b w"]:
        """Reflection coefficients at the bounces, with the gains of their planes."""
        planes = folded.planes
        cosines = folded.cosines
        real = 1 + self.log_permittivities.exp()
        imaginary = -self.log_conductivities.exp()
        permittivities = torch.complex(real, imaginary)[planes]  # (w,)
        if self.log_thicknesses is None:
            te, tm = fresnel(permittivities, cosines)
        else:
            wavelengths = speed_of_light / carriers(self.scene, query).to(cosines)[:, None]
            thicknesses = self.log_thicknesses[planes].exp() / wavelengths  # (b, w)
            te, tm = slab(permittivities, cosines, thicknesses)
        # A plane's gain falls off as a Gaussian about its middle; (b, w, 3), in extents.
        aside = (folded.bounces - self.middles[planes]) * (-self.log_extents[planes]).exp()
        gains = (self.plane_gains[planes] - aside.square().sum(-1) / 2).exp()
        return polarised(folded.normals, te, tm) * gains

    def _depths(
        self, obstacles: Obstacles, folded: Folded, strengths: Complex[Tensor, "b n"]
    ) -> Inexact[Tensor, "b n"]:
        """Depth of each path through the obstacles [Np]; 0 for a path that does not exist.

        With ``skips_faint`` the depth is 0 for faint paths, too. ``strengths`` are fields without
        obstacles, relative to free space.
        """
        depths = torch.zeros_like(strengths.real if obstacles.turns is None else strengths)
        with torch.no_grad():
            is_computed = strengths != 0  # (b, n)
            if self.skips_faint:
                spans = (folded.end - folded.start).norm(dim=-1)  # of the legs (b, s) [m]
                lengths = depths.real.index_add(1, folded.path, spans).clamp_min(NEAREST)
                powers = (strengths.abs() / lengths).square()
                is_computed = powers > self.faint * powers.sum(1, keepdim=True)
            # Numbers of the legs of these paths, among the legs of all links in a row (b s).
            legs = is_computed[:, folded.path].flatten().nonzero()[:, 0]
        starts = folded.start.flatten(0, 1).index_select(0, legs)
        ends = folded.end.flatten(0, 1).index_select(0, legs)
        count, n = strengths.shape
        # Number of each leg's path among the paths of all links in a row (b n).
        paths = folded.path + n * torch.arange(count, device=legs.device)[:, None]
        paths = paths.flatten()[legs]
        # The first leg ends at the receiver, the last one starts at the transmitter.
        sites = torch.stack((folded.end[:, 0], folded.start[:, -1]), 1)  # (b, 2, 3)
        links = legs // folded.start.shape[1]
        leg_depths = obstacles(starts, ends, obstacles.are_outside(sites)[links])
        return depths.flatten().index_add(0, paths, leg_depths).view(count, n)

    def passing(self, query: Query) -> Float[Tensor, "b v"]:
        """Amplitudes of the direct path and of the single reflection at each plane, in this order.

        They are relative to free space, with obstacles and without receiver gains. The amplitude of
        a path that does not exist is 0.
        """
        sequences = self.sequences[self.kept]  # (n, order)
        strengths = self.strengths(query, self.folded(query).paths).abs()  # (b, n)
        is_short = (sequences >= 0).sum(1) <= 1
        planes = sequences[is_short].amax(1)  # -1 for the direct path
        amplitudes = strengths.new_zeros(len(query), len(self.origin) + 1)
        amplitudes[:, planes + 1] = strengths[:, is_short]
        return amplitudes / self.gains_at(query.receivers).real[:, None].exp()

    def margins(self, query: Query) -> Complex[Tensor, "b n"]:
        """Prior standard deviation of the field of each of n kept paths, relative to free space.

        The deviation is the path's field times the share that obstacles block, plus a tenth of the
        field without obstacles. Its phase is the phase of the path's field.
        """
        links = self.folded(query)
        field = self.strengths(query, links.paths)
        unblocked = self.strengths(query, links.paths, blocked=False)
        least = torch.finfo(field.real.dtype).tiny
        blocked_share = 1 - field.abs() / unblocked.abs().clamp_min(least)
        return (blocked_share * field + 0.1 * unblocked) * self.patterns(query, links.ways)

    # --- bands ---

    def _number_bands(self) -> None:
        """Sets ``band_numbers``, the number of each receiver's band in ``bands``.

        Raises:
            ValueError: A new receiver has none of the bands of the training.
        """
        for receiver in self.scene.receivers:
            if receiver.band not in self.bands:
                raise ValueError(
                    f"receiver {receiver.name!r} must have a band of the training, one of "
                    f"{self.bands} [Hz]; give it, as in gaigs.Receiver(NAME, POSE, ARRAY, BAND)"
                )
        numbers = [self.bands.index(receiver.band) for receiver in self.scene.receivers]
        self.register_buffer("band_numbers", torch.tensor(numbers), persistent=False)

    def of_bands(self, strengths: Float[Tensor, "*bands n"], query: Query) -> Float[Tensor, "c n"]:
        """Gains or phases of paths in the band of each link's receiver; c is 1 with one band."""
        if len(self.bands) == 1:
            return strengths[None]
        return strengths[self.band_numbers[query.receivers]]

    # --- receivers ---

    def fit(self, links: Links) -> None:
        super().fit(links)
        heard = self.scene.radio_of(links.query.receivers[links.split.train]).unique()
        heard = heard.to(self.is_heard.device)
        self.is_heard.fill_(False)[heard] = True

    def gains_at(self, receivers: Int[Tensor, " b"]) -> Complex[Tensor, " b"]:
        """Logarithms of the receivers' complex gains; phases are 0 unless labels are channels."""
        gains = self._receiver_gains
        if not self.is_heard.all():
            gains = torch.where(self.is_heard, gains, self._common_gain(self.is_heard))
        return gains[self.scene.radio_of(receivers)]

    @property
    def _receiver_gains(self) -> Complex[Tensor, " r"]:
        """Logarithms of the learnt complex gains of all receivers."""
        gains, phases = self.receiver_gains, self.receiver_phases
        return torch.complex(gains, torch.zeros_like(gains) if phases is None else phases)

    def _common_gain(self, known: Tensor) -> Complex[Tensor, ""]:
        """Logarithm of the gain for an unknown receiver: the mean in dB, or of complex gains."""
        gains = self._receiver_gains[known]
        return gains.exp().mean().log() if self.is_complex else gains.mean()

    @torch.no_grad()
    def take_receivers(self, scene: Scene, known: Tensor | None = None) -> None:
        """Adapts parameters to the receivers of ``scene``, each of which gets the same mean gain.

        The mean is over the former receivers with the numbers ``known``. None: receivers with
        training links.
        """
        is_known = self.is_heard if known is None or scene.one_radio else known
        gains = self._common_gain(is_known)
        gains = gains.repeat(scene.radios)
        self.receiver_gains = nn.Parameter(gains.real.contiguous())
        if self.receiver_phases is not None:
            self.receiver_phases = nn.Parameter(gains.imag.contiguous())
        self.is_heard = torch.ones_like(gains.real, dtype=torch.bool)
        self.boresights = self._boresights()
        self._number_bands()

    def pattern(self, receiver: int, directions: Float[Tensor, "*b 3"]) -> Float[Tensor, "*b"]:
        """Field gain of a receiver's elements towards unit vectors in its frame.

        For an array with a ``boresight`` the gain includes the learnt power of the cosine of the
        angle to this direction. ``receiver`` is the receiver's number.
        """
        array = self.scene.receivers[receiver].array
        gain = array.gain(directions)
        normal = self.boresights[receiver]
        if len(array) == 1 or not normal.any():
            return gain
        cosines = directions @ normal.to(directions)
        cosines = cosines.clamp_min(0.05)  # the logarithm has no bound at 0
        return gain * cosines**self.directivity

    def patterns(self, query: Query, ways: Float[Tensor, "b n 3"]) -> Float[Tensor, "b n"]:
        """Field gain of the receivers' elements along ``ways``, vectors from the receivers [m]."""
        gains = torch.ones_like(ways[..., 0])
        for number in query.receivers.unique().tolist():
            receiver = self.scene.receivers[number]
            if receiver.array.is_point:  # its gain is 1
                continue
            rows = query.receivers == number
            directions = ways[rows] @ receiver.pose.rotation.to(ways)  # receiver's frame
            gains[rows] = self.pattern(number, functional.normalize(directions, dim=-1))
        return gains


def _filled(value: float, *shape: int) -> nn.Parameter:
    """A parameter whose elements all have one value."""
    return nn.Parameter(torch.full(shape, value))


def boresight(receiver: Receiver, middle: Float[Tensor, "3"]) -> Float[Tensor, "3"]:
    """Normal of a planar array in the array's frame; 0 if the elements do not span a plane.

    The normal is on the side of ``middle``, a point in the world frame [m].
    """
    elements = receiver.array.elements.double()
    # Elements of a plane scatter along two axes; the axis without scatter is the normal.
    _, scatters, axes = torch.linalg.svd(elements - elements.mean(0), full_matrices=True)
    flat = 1e-6 * scatters[0]  # float32 places elements no better
    if len(scatters) < 3 or scatters[2] > flat or scatters[1] <= flat:
        return torch.zeros(3)
    normal = axes[2].float()
    towards_middle = receiver.pose.to(middle).local(middle)
    return normal if normal @ towards_middle >= 0 else -normal
