"""Times predictions of a trained model on each device of this machine, for one link and for many.

    python benchmarks/devices.py runs/a-run/best.ckpt
    python benchmarks/devices.py runs/a-run/best.ckpt --links 4096

Places are drawn in the box of the training transmitters, all to the first receiver. Times are
medians, from positions to values on the device, and of many links their share for each.
"""

import argparse

import torch

import gaigs
from gaigs.report.table import markdown
from gaigs.runs.evaluation import device_name, median_ms


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("checkpoint")
    parser.add_argument("--links", type=int, default=512, help="of the second time")
    options = parser.parse_args()
    model = gaigs.load(options.checkpoint)
    lower, upper = model.scene.lower, model.scene.upper
    places = lower + (upper - lower) * torch.rand(
        options.links, 3, generator=torch.Generator().manual_seed(0)
    )
    lines = [["device", "one link [ms]", f"{options.links} links [ms each]"]]
    carrier = model.scene.middle_frequency
    for device in ("cpu", *(["cuda"] if torch.cuda.is_available() else [])):
        model.to(device)
        one = median_ms(lambda: model.predict(places[:1], 0, carrier))
        many = median_ms(lambda: model.predict(places, 0, carrier), 2, 9)
        lines.append([device_name(model.device), f"{one:.3g}", f"{many / len(places):.3g}"])
    print(markdown(lines))


if __name__ == "__main__":
    main()
