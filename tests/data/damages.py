"""Damages of files: one that a test chooses, and random ones."""

import re

NUMBERS = """nan -nan inf -inf .inf .nan 0 -0 -0.0 1e300 -1e300 1e400 1e-300 -1e-300 1e38 -1e38 1e-45 99999.999 1e5 -1e5
1_0 0x10 0b1 010 -010 1:30 2024-01-01 true null ~ 1e 1,5 1;5 "5" "5 5" '5' "5"6 １ ٣ 1d3 +5 -100 -99.999 -200 127
9223372036854775808 18446744073709551616 !!float_5 !x_5 *a &a_5 {} [] [5] # : , - -- | > % @ ` \\""".replace(
    "_5", " 5"
)
"""Replacements of a number in a text, besides integers of hundreds and thousands of digits."""

WORDS = [*NUMBERS.split(), "", " ", "9" * 400, "9" * 5000, "1" + "0" * 399]


def replace(file, old, new):
    """The file with other text: all of it if old is None, and no file if new is None."""
    if new is None:
        file.unlink()
    elif old is None:
        file.write_text(new)
    else:
        text = file.read_text()
        assert old in text
        file.write_text(text.replace(old, new, 1))


# --- random damages: each takes bytes and a generator, and gives bytes ---


def flip(content, draw):
    at = draw.randrange(len(content))
    return content[:at] + bytes([content[at] ^ 1 << draw.randrange(8)]) + content[at + 1 :]


def truncate(content, draw):
    return content[: draw.randrange(len(content))]


def insert(content, draw):
    at = draw.randrange(len(content) + 1)
    return (
        content[:at]
        + draw.choice([draw.randbytes(3), b"\0", b'"', b"[", b"\\", b"\x0c", b"\xe9"])
        + content[at:]
    )


def renumber(content, draw):
    places = [match.span() for match in re.finditer(rb"-?\d+\.?\d*", content)]
    start, stop = draw.choice(places)
    return content[:start] + draw.choice(WORDS).encode() + content[stop:]


def repeat_line(content, draw):
    lines = content.splitlines(keepends=True)
    lines.insert(draw.randrange(len(lines) + 1), draw.choice(lines))
    return b"".join(lines)


def recode(content, draw):
    text = content.decode()
    coded = {
        "utf-16": text,
        "utf-16-le": text,
        "utf-32": text,
        "latin-1": f"é{text}",
        "utf-8-sig": text,
        "cp500": text,
    }
    name = draw.choice([*coded])
    return coded[name].encode(name)


BYTES = [flip, flip, truncate, insert]
TEXTS = [*BYTES, renumber, renumber, renumber, repeat_line, recode]
