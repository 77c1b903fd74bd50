"""``python -m gaigs.report FOLDER``: the runs of a Hydra multirun as one table."""

from argparse import ArgumentParser
from pathlib import Path

from rich.console import Console

from gaigs.report.multirun import report


def main() -> None:
    """Prints the table of a multirun folder and writes it, with a figure, into that folder."""
    parser = ArgumentParser(prog="python -m gaigs.report", description=__doc__)
    parser.add_argument("folder", type=Path, help="folder that Hydra made for python -m gaigs --multirun ...")
    try:
        table = report(parser.parse_args().folder)
    except (FileNotFoundError, ValueError) as error:
        parser.error(str(error))
    Console().print(table)


if __name__ == "__main__":
    main()
