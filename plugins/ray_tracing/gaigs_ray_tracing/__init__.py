"""Ray tracing in a room whose geometry is known, with materials learnt from the training links or
as tabulated.
"""

import math
from collections.abc import Mapping

import torch
from gaigs_sionna.meshes import THICKNESS
from gaigs_sionna.tracing import frequency_offsets
from jaxtyping import Float
from scipy.constants import epsilon_0
from torch import Tensor, nn

from gaigs.core.propagation import fit_gain, free_space
from gaigs.core.query import Batch, Query, check_carrier
from gaigs.core.scene import Scene, carriers, check_elements, direct_waves
from gaigs.data import Links
from gaigs.data.synthetic.image_source import MATERIALS, Paths, respond
from gaigs.io.meshes import wavefront_obj
from gaigs.model import Model, Prediction
from gaigs.splatting.pooling.beamformer import Beamformer

from .fields import Slabs, gains, padded
from .rooms import check_room, find_meshes, known_materials, read_obj
from .tracer import Tracer, find_tracer

NEPER = 20 / math.log(10)
"""One neper of a field [dB]."""

SILENT = 1e-15
"""Share of the power sent that a receiver reports where no path leads: -150 dB, below the noise of
any.
"""

BATCH = 64
"""Links that are fitted to at a time."""


class RayTracing(Model):
    """Paths by Sionna RT, waves summed up along them at each element of the receiver's array.

    A path's points do not depend on the materials of the surfaces, so each link is traced once. Its
    gain follows from Fresnel's formulas for slabs: each material's permittivity is 1 + (e - 1) a
    and its conductivity s b, with e and s as tabulated and a, b learnt, 1 at the start. Diffracted
    paths keep the gain that they have at the start.

        channels    h = g sum_p h_p at each element and subcarrier, one complex gain g a receiver
        RSSI        10 log10 of the mean of |h|^2 over the data's band; the paths' powers add where
                    the band is unknown
        spectra     the conventional beamformer's amplitude over the band, scaled as the labels are

    ``fit`` takes each receiver's gain from the training links, their median: transmit power, cables
    and the clock's phase. It is trained with the materials. All this is computed on the processor.

    Args:
        scene: Receivers and task.
        room: ``built_in``, or a room of the data set ``sionna``.
        mesh: File of one's own room instead (.obj, .ply, .xml) [m]; None for the room of that name.
            It is read in ``fit``, and is in the state dict.
        materials: Tabulated material for each material of the mesh, by its name there.
        calibrate: True to train materials and gains. Else materials are as tabulated, and nothing
            is trained.
        frequency: Carrier of links where the data have none [Hz]; None where they have.
        depth: Largest number of reflections, passages through surfaces and diffractions of a path.
        rays: Number of rays from each transmitter.

    Raises:
        ValueError: The room is unknown, an option is out of range, or the labels are neither
            spectra, nor RSSI, nor channels of the receivers' arrays.

    Source: Sionna RT technical report, arXiv:2504.21719; slabs and materials as in ITU-R P.2040-3.
    """

    # Of logarithms [1], and of gains [Np, rad]: slower, so that materials explain most.
    learning_rates: Mapping[str, float] = {"materials": 5e-2, "gains": 5e-3}
    any_frequency = True

    def __init__(
        self,
        scene: Scene,
        room: str,
        mesh: str | None,
        materials: dict,
        calibrate: bool,
        frequency: float | None,
        depth: int,
        rays: int,
    ):
        super().__init__(scene)
        if mesh is None:
            check_room(room)
        if frequency is not None:
            check_carrier("model.frequency", frequency)
        if not 1 <= depth <= 8:
            raise ValueError(f"model.depth must be in 1..8, got {depth}")
        if rays < 1:
            raise ValueError(f"model.rays must be at least 1, got {rays}")
        self.room = room
        self.mesh = mesh
        self.materials = materials
        self.frequency = frequency
        self.depth = depth
        self.rays = rays
        self.beamformer = _beamformer(scene)
        learnt = {"log_permittivities": torch.zeros(0), "log_conductivities": torch.zeros(0)}
        if self.beamformer is None:
            # ln of amplitude, phase [rad]
            learnt["log_gains"] = torch.zeros(len(scene.receivers), 2)
        for name, start in learnt.items():
            if calibrate:
                self.register_parameter(name, nn.Parameter(start))
            else:
                self.register_buffer(name, start)
        self.register_buffer("sign", torch.tensor(-1))  # of phases: -1 for exp(+j omega t)
        self.register_buffer("surfaces", torch.zeros(0, dtype=torch.uint8))  # an OBJ file

    # --- the room ---

    def _furnish(self, text: str) -> None:
        """Sets the room's surfaces and materials, from the text of an OBJ file.

        ``fit`` calls it, and the loading of a state.
        """
        self.text = text
        meshes = read_obj(text, "the room")
        self.known = known_materials(meshes, self.materials)
        self.offsets = torch.zeros(1)
        band = self.scene.bandwidth
        if band and not self.scene.task.dtype.is_complex:
            self.offsets = frequency_offsets(meshes, band)
        for parameter in (self.log_permittivities, self.log_conductivities):
            parameter.data = parameter.data.new_zeros(len(self.known))

    def _load_from_state_dict(self, state_dict, prefix, *args):
        stored = state_dict.get(f"{prefix}surfaces")
        if stored is not None:
            self.surfaces = self.surfaces.new_empty(stored.shape)
            self._furnish(stored.cpu().numpy().tobytes().decode())
        super()._load_from_state_dict(state_dict, prefix, *args)

    # --- training ---

    def fit(self, links: Links) -> None:
        """Reads the room, traces the links' paths, and fits each receiver's gain.

        Raises:
            FileNotFoundError, ImportError, RuntimeError: As ``gaigs_ray_tracing.rooms.find_meshes``
                and ``gaigs_sionna.tracing.make_scene``.
            ValueError: The mesh is damaged or of unknown materials.
        """
        text = wavefront_obj(find_meshes(self.room, self.mesh))
        device = self.surfaces.device
        self.surfaces = torch.tensor(list(text.encode()), dtype=torch.uint8, device=device)
        self._furnish(text)  # as written, so that a checkpoint has the same
        frequencies = self._carriers(links.query)
        for carrier in frequencies.unique().tolist():
            self._tracer(carrier).remember(links.query.transmitters[frequencies == carrier])
        if self.beamformer is None:
            self._fit_gains(links)

    @torch.no_grad()
    def _fit_gains(self, links: Links) -> None:
        """Fits each receiver's gain to the training links, and for channels the sign of phases.

        A receiver without training links gets the median amplitude of the others.
        """
        train = links.split.train
        labels = links.labels[train]
        query = links.query[train]
        is_complex = labels.is_complex()
        if is_complex:
            waves = direct_waves(self.scene, query, self.scene.task.frequencies)
            sign = self.scene.task.phase_sign(labels.to(torch.complex128), waves, query.receivers)
            self.sign.fill_(sign or -1)
        self.log_gains.zero_()
        values = torch.cat([self(Batch(part)).value for part in query.parts(BATCH)])
        for receiver in query.receivers.unique().tolist():
            rows = query.receivers == receiver
            if is_complex:
                gain = fit_gain(labels[rows], values[rows])
                if gain != 0:
                    phase = -int(self.sign) * gain.angle()
                    self.log_gains[receiver] = torch.stack((gain.abs().log(), phase))
            else:
                self.log_gains[receiver, 0] = (labels[rows] - values[rows]).median() / NEPER
        trained = query.receivers.unique()
        untrained = torch.ones(len(self.log_gains), dtype=torch.bool).index_fill(0, trained, False)
        if len(trained):
            self.log_gains[untrained, 0] = self.log_gains[trained, 0].median()

    @property
    def predicts_untrained(self) -> bool:
        return True

    def parameter_groups(self) -> dict[str, list[nn.Parameter]]:
        """Parameters of the materials, and the receivers' gains; empty without calibration."""
        parameters = dict(self.named_parameters())
        names = ("log_permittivities", "log_conductivities")
        materials = [parameters[name] for name in names if name in parameters]
        gains = [parameters["log_gains"]] if "log_gains" in parameters else []
        return {"materials": materials, "gains": gains}

    def facts(self) -> dict[str, object]:
        """Materials of the surfaces at the lowest carrier, and the time to trace a place."""
        lowest = self.scene.frequencies[:1] if len(self.scene.frequencies) else None
        query = Query(self.scene.lower[None], torch.tensor([0]), lowest)
        carrier = self._carriers(query).item()
        permittivities = self.slabs(carrier).permittivities.detach()
        materials = {}
        for name, value in zip(self.known, permittivities, strict=True):
            materials[name] = {
                "permittivity": value.real.item(),
                "conductivity": -value.imag.item() * 2 * math.pi * carrier * epsilon_0,
            }
        tracer = self._tracer(carrier)
        milliseconds = 1e3 * tracer.seconds / tracer.places if tracer.places else None
        return {"materials": materials, "tracing_ms": milliseconds}

    # --- prediction ---

    def forward(self, batch: Batch) -> Prediction:
        query = batch.query.to("cpu")
        frequencies = self._carriers(query)
        task = self.scene.task
        shape = task.shape
        if self.beamformer is not None:
            shape = (batch.directions or task.directions).shape
        dtype = query.transmitters.dtype
        dtype = dtype.to_complex() if task.dtype.is_complex else dtype
        value = torch.zeros(len(query), *shape, dtype=dtype)
        for carrier in frequencies.unique().tolist():
            for receiver in query.receivers.unique().tolist():
                is_part = (frequencies == carrier) & (query.receivers == receiver)
                links = is_part.nonzero()[:, 0]
                if len(links):
                    part = self._report(query[links], receiver, carrier, batch)
                    value = value.index_add(0, links, part.to(value.dtype))
        return Prediction(value.to(batch.query.transmitters.device), {})

    def _report(self, query: Query, receiver: int, carrier: float, batch: Batch) -> Tensor:
        """Labels of links to one receiver at one carrier [Hz]."""
        antenna = self.scene.receivers[receiver]
        task = self.scene.task
        links = self._tracer(carrier).find(query.transmitters, receiver)
        traced = padded(links, antenna.pose.position)
        paths = Paths(traced.images, gains(traced, self.slabs(carrier)))
        if task.dtype.is_complex:
            amplitude, phase = self.log_gains[receiver].cpu().double()
            channels = respond(paths, antenna, carrier, task.frequencies - carrier)
            channels = channels * torch.polar(amplitude.exp(), phase)
            return channels.conj() if self.sign > 0 else channels
        if self.beamformer is not None:
            waves = respond(paths, antenna, carrier, self.offsets)
            lags = antenna.array.by_lag(waves @ waves.mH / waves.shape[-1])
            return self.beamformer(lags.to(torch.complex64), query, batch.directions)
        if self.scene.bandwidth is None:
            distances = (paths.images - antenna.pose.position.double()).norm(dim=-1)
            spreading = free_space(distances, torch.tensor(carrier), 0).real
            powers = (paths.gains.abs() * spreading).square().sum(1)
        else:
            powers = respond(paths, antenna, carrier, self.offsets).abs().square().mean((1, 2))
        return 10 * (powers + SILENT).log10() + NEPER * self.log_gains[receiver, 0].cpu().double()

    def slabs(self, carrier: float) -> Slabs:
        """Materials of the surfaces at a carrier [Hz], with the learnt factors."""
        kinds = [*self.known.values()]
        tabulated = torch.tensor([MATERIALS[kind] for kind in kinds], dtype=torch.float64)
        real, c, d = tabulated.T
        # ITU-R P.2040-3: conductivity c (f / GHz)^d, permittivity real - j conductivity / (w e0).
        conductivities = c * (carrier / 1e9) ** d * self.log_conductivities.cpu().double().exp()
        permittivities = torch.complex(
            1 + (real - 1) * self.log_permittivities.cpu().double().exp(),
            -conductivities / (2 * math.pi * epsilon_0 * carrier),
        )
        thicknesses = torch.tensor([THICKNESS[kind] for kind in kinds], dtype=torch.float64)
        return Slabs(permittivities, thicknesses, carrier)

    def _tracer(self, carrier: float) -> Tracer:
        """The tracer of the room at a carrier [Hz]; models of one room share it."""
        receivers = tuple(
            tuple(receiver.pose.position.double().tolist()) for receiver in self.scene.receivers
        )
        known = tuple(self.known.items())
        return find_tracer(self.text, known, receivers, carrier, self.depth, self.rays)

    def _carriers(self, query: Query) -> Float[Tensor, " b"]:
        """The frequency of each link [Hz]."""
        has_carrier = query.frequencies is not None or self.scene.task.dtype.is_complex
        if self.frequency is not None and not has_carrier:
            return torch.full((len(query),), float(self.frequency))
        return carriers(self.scene, query)


def _beamformer(scene: Scene) -> Beamformer | None:
    """The beamformer of spectra; None for channels and levels.

    Raises:
        ValueError: Labels are of another kind.
    """
    if scene.task.dtype.is_complex:
        check_elements("model 'ray_tracing'", scene)
        return None
    if scene.task.directions is not None:
        return Beamformer("model 'ray_tracing'", scene)
    if scene.task.unit != "dBm":
        raise ValueError(
            "model 'ray_tracing' predicts spectra, RSSI and channels, not labels of task "
            f"{scene.task.name!r}; use another model"
        )
    return None
