"""Channels for data=csi_npz from packets of ultra-wideband radios: one a place and receiver.

    python examples/packets.py PACKETS.npz ROOM.npz --bandwidth 500e6
    python -m gaigs +experiment=csi data=csi_npz data.file=ROOM.npz data.phase=per_link_and_delay

PACKETS.npz has ``tx``, ``rx`` and ``rx_index`` as for ``data=csi_npz``, one packet a row, and

    taps          (n, t)   impulse responses, complex
    first_path    (n,)     where the first path is in the taps, with a fraction
    spacing       (1,)     time from tap to tap [s]
    carrier       (1,)     middle of the band [Hz]
    noise         (n,)     optional: root mean square of the noise of a tap; by default that of the
                           taps before the first path

or, in place of the taps, channels ``h`` (n, e, s) at ``frequencies`` (s,) [Hz].

Taps become channels by a Fourier transform about the first path, since the radio's time of
transmission is unknown. Packets of one place have a phase, a delay and a gain of their own. So each
is turned onto the mean of the others and scaled to one power before it counts, by the inverse of
its noise and of the scatter between packets.
"""

import argparse
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy import ndarray

from gaigs.core.phases import alignment
from gaigs.data.impulse_responses import to_channels


class Packets(NamedTuple):
    """Channels (n, e, s) at frequencies (s,) [Hz], and the noise power of each number (n,)."""

    channels: ndarray
    frequencies: ndarray
    noise: ndarray


def from_taps(
    content: dict[str, ndarray], bandwidth: float, before: float = 2.0, after: float = 100e-9
) -> Packets:
    """Channels of impulse responses about their first paths.

    Args:
        content: Arrays of the file.
        bandwidth: Width of the band that the radio occupies [Hz].
        before: Kept ahead of the first path [1 / bandwidth]: the rise of a pulse.
        after: Kept behind it [s]: a path of 30 m more.
    """
    taps, first = content["taps"], content["first_path"]
    spacing, carrier = (
        float(np.ravel(content["spacing"])[0]),
        float(np.ravel(content["carrier"])[0]),
    )
    if taps.ndim != 2 or first.shape != taps.shape[:1] or not (first < taps.shape[1]).all():
        raise ValueError(
            "expected taps (n, t) and first_path (n,) within them, got "
            f"{taps.shape} and {first.shape}"
        )
    delays = (np.arange(taps.shape[1]) - first[:, None]) * spacing  # (n, t) [s]
    is_noise = delays < -before / bandwidth
    is_kept = ~is_noise & (delays <= after)
    power = (np.abs(taps) ** 2 * is_noise).sum(1) / is_noise.sum(1).clip(1)  # (n,)
    if "noise" in content:
        power = content["noise"] ** 2
    # The channel repeats with one over the length of the taps that are kept.
    length = after + before / bandwidth
    offsets = np.arange(-bandwidth / 2, bandwidth / 2 + 1e-3, 1 / length)
    offsets -= offsets.mean()
    channels = to_channels((taps * is_kept)[:, None], delays[:, None], offsets)
    # Each number adds up the noise of all taps that are kept.
    return Packets(channels, carrier + offsets, power * is_kept.sum(1))


def average(packets: Packets, rounds: int = 4) -> ndarray:
    """The mean channel (e, s) of the packets of one place, turned onto each other.

    The mean has the gain, phase and delay of a usual packet, of which no link is known.
    """
    channels = torch.from_numpy(packets.channels).to(torch.complex128)
    frequencies = torch.from_numpy(packets.frequencies)
    count = channels[0].numel()
    powers = channels.abs().square().mean((1, 2))  # (n,)
    noise = torch.from_numpy(packets.noise) / powers  # (n,), over the whole power
    signal = (1 - noise).clamp_min(0.05)
    channels = channels / (powers * signal).sqrt()[:, None, None]
    noise = noise / signal
    mean = channels[noise.argmin()]
    weights = torch.ones_like(noise)
    for _ in range(rounds):
        turned = channels * alignment(channels, mean[None], frequencies)
        mean = (weights[:, None, None] * turned).sum(0) / weights.sum()
        errors = (turned - mean).abs().square().mean((1, 2))  # (n,)
        # People move and clocks drift: even packets without noise differ.
        scatter = (errors - noise).median().clamp_min(1 / count**2)
        weights = 1 / (noise + scatter)
    return (mean * (powers * signal).median().sqrt()).numpy()


def convert(content: dict[str, ndarray], bandwidth: float) -> dict[str, ndarray]:
    """Arrays for ``data=csi_npz`` with one link for each place and receiver."""
    if "taps" in content:
        packets = from_taps(content, bandwidth)
    else:
        noise = content.get("noise", np.zeros(len(content["h"]))) ** 2
        packets = Packets(content["h"], content["frequencies"], noise)
    numbers = content.get("rx_index", np.zeros(len(content["tx"]), int))
    ends = np.column_stack((content["tx"], numbers))
    links, index = np.unique(ends, axis=0, return_inverse=True)
    means = []
    for link in range(len(links)):
        rows = np.flatnonzero(index.ravel() == link)
        means.append(
            average(Packets(packets.channels[rows], packets.frequencies, packets.noise[rows]))
        )
    made = {name: content[name] for name in ("rx", "elements") if name in content}
    return made | {
        "tx": links[:, :3],
        "rx_index": links[:, 3].astype(int),
        "frequencies": packets.frequencies,
        "h": np.array(means),
    }


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("packets", type=Path)
    parser.add_argument("room", type=Path)
    parser.add_argument("--bandwidth", type=float, default=500e6)
    arguments = parser.parse_args()
    with np.load(arguments.packets) as content:
        made = convert(dict(content), arguments.bandwidth)
    np.savez(arguments.room, **made)
    print(f"{arguments.room}: {len(made['h'])} links at {len(made['frequencies'])} subcarriers")


if __name__ == "__main__":
    main()
