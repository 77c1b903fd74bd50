"""``python -m gaigs.report FOLDER``: the runs of a multirun as tables, with spread over seeds."""

from argparse import ArgumentParser
from pathlib import Path

from rich.console import Console

from gaigs.report.formats import figure_formats
from gaigs.report.multirun import report


def main() -> None:
    """Prints the tables of a multirun folder and writes them, with a figure, into that folder."""
    parser = ArgumentParser(prog="python -m gaigs.report", description=__doc__)
    about = "folder that Hydra made for python -m gaigs --multirun ..., or one above several"
    parser.add_argument("folder", type=Path, help=about)
    parser.add_argument(
        "--format", default="png", help="of the figure files: png, pdf or svg, or several: png,pdf"
    )
    arguments = parser.parse_args()
    try:
        with figure_formats(arguments.format.split(",")):
            tables = report(arguments.folder)
    except (FileNotFoundError, ValueError) as error:
        parser.error(str(error))
    Console(emoji=False).print(tables)


if __name__ == "__main__":
    main()
