"""Changes to files: of bytes, of words, and of what they mean. Each is drawn by one generator."""

import json
import random
import re
import struct
from collections.abc import Callable
from typing import Any, TypeAlias

from midway import files
from midway.training.arrays import ABOUT

Mutate: TypeAlias = Callable[[random.Random, bytes], bytes]

DEEP, LONG = "@deep@", "@long@"
"""Stand for lists within each other and for thousands of digits."""

VALUES: tuple[Any, ...] = (
    *(None, True, False, 0, -1, 1, 7, 2**31, 2**63, 2**64, 10**12, -(10**30), 0.5, -0.0, 1e308),
    *(float("nan"), float("inf"), "", "0", "1e400", "nan", "x", "é", "\ud800", "\x00", "a\nb"),
    *("<script>alert(1)</script>", "../../x", "-1", "[60000, 60000]", "y" * 10_000, DEEP, LONG),
    *([], {}, [0], [None], [[1]], [60_000, 60_000], {"x": 1}, [1e400], {"": {}}, [2**40, 2**40]),
    *("sac", "ris", "leap", "point-u", "ant-u", "json:loads", "a:b", ":", ".:x", "..a:b", [8] * 70),
)
"""What stands in the place of a value."""

PIECES = (
    *(b"", b"\x00", b"\xff", b"\xc3", b"\n", b"\r", b'"', b"'", b",", b":", b"{", b"}", b"[", b"]"),
    *(b"[" * 1_500, b"{'a':" * 400, b"9" * 5_000, b"1e999", b"nan", b"-1", b"0", b"true", b"#"),
    *(b"&a [*a]", b"<<: *a", b"!!python/object/apply:os.system ['x']", b"2001-99-99", b"0x", b"="),
    *(b"\xef\xbb\xbf", b"\xf0\x9f\x90\x9c", b"S", b"G", b".", b"x" * 150_000, b"\x7f" * 8, b"_"),
)
"""What stands in the place of bytes or words."""


def either(*ways: Mutate) -> Mutate:
    """Return one of several changes, at random."""
    return lambda chance, content: chance.choice(ways)(chance, content)


def of_bytes(chance: random.Random, content: bytes) -> bytes:
    """Return bytes with one to four places flipped, cut, zeroed, repeated or replaced."""
    found = bytearray(content)
    for _ in range(chance.randint(1, 4)):
        here, there = sorted(chance.randint(0, len(found)) for _ in range(2))
        near = min(len(found), here + chance.choice((1, 2, 8, 64)))
        match chance.randrange(7):
            case 0 if found:
                found[here % len(found)] ^= 1 << chance.randrange(8)
            case 1:
                del found[here:near]
            case 2:
                del found[there:]
            case 3:
                found[here:near] = bytes(near - here)
            case 4:
                found[here:here] = found[here:near]
            case 5:
                found[here:near] = chance.choice(PIECES)
            case _:
                found[there:there] = found[here:near]
    return bytes(found)


def of_words(chance: random.Random, content: bytes) -> bytes:
    """Return text with one to four of its words or signs replaced, removed or repeated."""
    words = re.findall(rb"(?s)[\w.+-]+|\s+|.", content) or [b""]
    for _ in range(chance.randint(1, 4)):
        place = chance.randrange(len(words))
        value = str(chance.choice(VALUES)).encode(errors="surrogatepass")
        new = (b"", chance.choice(PIECES), chance.choice(words), value, words[place] * 2)
        words[place] = chance.choice(new)
    return filled(b"".join(words), chance)


class Twice(dict[str, Any]):
    """An object that names its first key twice."""

    def items(self) -> Any:
        return [*super().items(), *list(super().items())[:1]]


def of_value(chance: random.Random, value: Any) -> Any:
    """Return a JSON value with one place replaced, removed, renamed or repeated."""
    if not isinstance(value, dict | list) or not value or chance.random() < 0.1:
        return chance.choice(VALUES)
    inside: Any = dict(value) if isinstance(value, dict) else list(value)
    key = chance.choice(list(inside)) if isinstance(inside, dict) else chance.randrange(len(inside))
    match chance.randrange(8):
        case 0:
            del inside[key]
        case 1 if isinstance(inside, dict):
            inside[str(chance.choice(VALUES))] = inside.pop(key)
        case 2 if isinstance(inside, dict):
            return Twice({key: of_value(chance, inside[key]), **inside})
        case 2:
            inside *= chance.choice((2, 1000))
        case _:
            inside[key] = of_value(chance, inside[key])
    return inside


def of_object(chance: random.Random, content: bytes) -> bytes:
    """Return a JSON object with up to three changed places and, mostly, a checksum that fits."""
    values = json.loads(content)
    for _ in range(chance.randint(1, 3)):
        values = of_value(chance, values)
    if isinstance(values, dict) and chance.random() < 0.8:
        values = files.sealed({k: v for k, v in values.items() if k != files.SEAL})
    return filled(json.dumps(values).encode(), chance)


def filled(text: bytes, chance: random.Random) -> bytes:
    """Replace what stands for long text; a checksum fits it no more."""
    depth = chance.choice((100, 400, 900, 5_000, 100_000))
    text = text.replace(f'"{DEEP}"'.encode(), b"[" * depth + b"]" * depth)
    return text.replace(f'"{LONG}"'.encode(), b"9" * 5_000)


def of_arrays(chance: random.Random, content: bytes) -> bytes:
    """Return a safetensors file with its header changed, or what it says of itself."""
    size = struct.unpack("<Q", content[:8])[0]
    header, data = json.loads(content[8 : 8 + size]), content[8 + size :]
    if chance.random() < 0.5:
        said = header["__metadata__"][ABOUT].encode()
        header["__metadata__"][ABOUT] = of_object(chance, said).decode(errors="replace")
    else:
        header = of_value(chance, header)
    text = filled(json.dumps(header).encode(), chance)
    length = chance.choice((len(text), len(text), len(text), 0, 2**63, len(text) + 1))
    return struct.pack("<Q", length) + text + data


def of_cells(chance: random.Random, content: bytes) -> bytes:
    """Return a CSV file with cells, rows or a column changed."""
    rows = [line.split(b",") for line in content.split(b"\r\n")]
    for _ in range(chance.randint(1, 3)):
        row = chance.randrange(len(rows))
        cell = chance.randrange(len(rows[row]) or 1)
        value = str(chance.choice(VALUES)).encode(errors="surrogatepass")
        match chance.randrange(6):
            case 0:
                rows.insert(row, list(chance.choice(rows)))
            case 1 if len(rows) > 1:
                del rows[row]
            case 2:
                for line in rows:
                    del line[cell : cell + 1]
            case 3:
                rows[row].append(value)
            case _:
                rows[row][cell : cell + 1] = [value]
    return b"\r\n".join(b",".join(row) for row in rows)
