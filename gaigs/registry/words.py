"""Words for error messages: lists, and the most similar known word."""

import difflib
from collections.abc import Iterable


def suggest(word: str, known: Iterable[str]) -> str:
    """A word in quotes, with the most similar known word if there is one."""
    near = similar(word, known)
    return f"{word!r} (did you mean {near[0]!r}?)" if near else repr(word)


def similar(word: str, known: Iterable[str]) -> list[str]:
    """The known word most similar to a word, in a list; empty if no word is similar.

    Words of other programs count as the corresponding names of gaigs.
    """
    translations = {
        "lr": "learning_rates",
        "epoch": "max_steps",
        "epochs": "max_steps",
        "iterations": "max_steps",
    }
    return difflib.get_close_matches(translations.get(str(word), str(word)), known, n=1)


def listed(words: Iterable[str]) -> str:
    """Words joined by commas; ``none`` without any."""
    return ", ".join(words) or "none"
