"""Extension of griffe, which reads ``Examples:`` alone, for docstrings of one ``Example:``."""

import re

from griffe import Extension


class OneExample(Extension):
    """Renames the section before docstrings are parsed."""

    def on_object(self, *, obj, **_):
        if obj.docstring:
            obj.docstring.value = re.sub(
                r"^Example:$", "Examples:", obj.docstring.value, flags=re.M
            )
