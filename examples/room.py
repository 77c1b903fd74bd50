"""Makes examples/room.ckpt, mirrored Gaussians of the built-in room's spectra: python
examples/room.py (a minute).
"""

from pathlib import Path

import gaigs


def main():
    links = gaigs.links("synthetic")
    # Without kriging: its interpolated spectra would be most of the file.
    model = gaigs.train("mirrored", links, max_steps=400, kriging=False)
    print(gaigs.evaluate(model, links))
    model.save(Path(__file__).with_suffix(".ckpt"))


if __name__ == "__main__":
    main()
