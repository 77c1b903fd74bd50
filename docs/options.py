"""Tables of options, drawn from the docstring of each component when the site is built.

A line ``::: options KIND NAME [OTHERS]`` on a page stands for the options of a component. Where its
docstring refers to another component's, the others are named after it.
"""

import inspect
import re

from gaigs.registry import registry

LINE = re.compile(r"^::: options (\w+) (\w+(?: \w+)*)$", re.M)
REQUIRED = "???"


def described(component) -> dict[str, str]:
    """Descriptions of arguments in a docstring in Google style, by argument."""
    section = re.search(r"^Args:\n(.*?)(?=^\S|\Z)", inspect.getdoc(component) or "", re.M | re.S)
    texts = {}
    if section is None:
        return texts
    for entry in re.split(r"^ {4}(?=\S)", section[1], flags=re.M)[1:]:
        names, _, text = entry.partition(":")
        for name in names.split(","):
            texts[name.strip()] = " ".join(text.split())
    return texts


def rows(kind: str, name: str, *others: str) -> list[tuple[str, str, str]]:
    """Key, default and description of each option.

    Raises:
        LookupError: No docstring describes an option.
    """
    texts = [described(registry(kind).get(each)) for each in (name, *others)]
    found = []
    for option, default in registry(kind).options(name).items():
        text = next((text[option] for text in texts if option in text), None)
        if text is None:
            raise LookupError(f"no docstring describes the option {option} of {kind} {name!r}")
        shown = "" if default == REQUIRED else f"`{_printed(default)}`"
        found.append((f"`{kind}.{option}`", shown, text.replace("``", "`").replace("|", "\\|")))
    return found


def table(kind: str, name: str, *others: str) -> str:
    """The options of a component in Markdown."""
    lines = [f"| option of `{name}` | default | meaning |", "|---|---|---|"]
    lines += [f"| {' | '.join(cells)} |" for cells in rows(kind, name, *others)]
    return "\n".join(lines)


def fill_in(markdown: str) -> str:
    """A page with its tables of options."""
    return LINE.sub(lambda match: f"\n{table(match[1], *match[2].split())}\n", markdown)


def _printed(default) -> str:
    """A default as in a configuration."""
    words = {None: "null", True: "true", False: "false"}
    if default is None or isinstance(default, bool):
        return words[default]
    if isinstance(default, list | tuple):
        return f"[{', '.join(_printed(part) for part in default)}]"
    return str(default)
