"""Hooks of mkdocs: the repository's layout, notebooks, tables of options, and the viewer."""

import re
from pathlib import Path

from mkdocs.plugins import event_priority
from mkdocs.structure.files import File, Files
from nbconvert import MarkdownExporter
from options import fill_in

import gaigs

ROOT = Path(__file__).parents[1]
PAGES = [
    "README.md",
    "CHANGELOG.md",
    "CONTRIBUTING.md",
    "LICENSE",
    "CITATION.cff",
    "plugins/*/README.md",
    "docs/**/*.*",
]


@event_priority(100)  # before the plugins
def on_files(files, config):
    """The files of the theme and of the pages, below the repository's root in place of ``docs``."""
    found = [file for file in files if file.src_dir != config.docs_dir]
    for path in (
        path for pattern in PAGES for path in sorted(ROOT.glob(pattern)) if path.suffix != ".py"
    ):
        name = path.relative_to(ROOT).as_posix()
        if path.suffix == ".ipynb":
            found += _notebook(config, name)
        if "__pycache__" not in path.parts:
            found.append(File(name, str(ROOT), config.site_dir, config.use_directory_urls))
    view = gaigs.view(gaigs.load(ROOT / "examples/room.ckpt"), gaigs.links("synthetic"))
    found.append(File.generated(config, "docs/room.html", content=view.page(view.stored())))
    return Files(found)


def _notebook(config, name):
    """The page of a notebook, and its pictures."""
    text, resources = MarkdownExporter().from_filename(ROOT / name)
    stem = name.removesuffix(".ipynb")
    pictures = {f"{stem}/{file}": content for file, content in resources["outputs"].items()}
    text = text.replace("](output_", f"]({Path(stem).name}/output_")
    text = text.replace("\n", f"\n\n[Download this notebook]({Path(name).name})\n", 1)
    yield File.generated(config, f"{stem}.md", content=text)
    yield from (File.generated(config, path, content=content) for path, content in pictures.items())


def on_page_markdown(markdown, page, **_):
    """Fills in tables of options, the pages of notebooks and the file of the viewer."""
    if page.file.generated_by:
        return markdown
    markdown = fill_in(markdown)
    if page.file.src_uri == "docs/view.md":
        style = 'style="width: 100%; height: 40rem"'
        frame = f'<iframe src="room.html" title="The built-in room" {style}></iframe>'
        markdown = re.sub(r"!\[[^]]*\]\(figures/view.png\)", frame, markdown, count=1)
    return re.sub(r"(\]\([^)\s]+)\.ipynb\)", r"\1.md)", markdown)
