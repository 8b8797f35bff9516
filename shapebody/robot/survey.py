"""What a robot file asks for, judged from its text and the sizes of the files that it names.

The survey sees what MuJoCo's lenient parser sees, which is not always correct XML. It takes time in
proportion to the text, and refuses what can only overflow, take forever or fill the memory.
"""

from __future__ import annotations

import hashlib
import html
import math
import os
import re
import stat
import struct
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

MAX_NUMBERS = 500
"""Numbers that MuJoCo reads in an entry of <custom>, where each joint needs one."""
MAX_DEPTH = 480
"""Elements inside each other: MuJoCo reads up to 500, and a completed file has a few more."""

_BYTES = "bytes of meshes and pictures"
_MOST = {  # in a robot with all its files; the shipped ones have up to 800 elements
    "bytes of text": 2**24,
    "elements": 20_000,
    "joints": MAX_NUMBERS,
    _BYTES: 2**29,
    "pixels of textures": 2**26,
    "points of height fields": 2**22,
    "rays of range finders": 10_000,
}
_ADVICE = {
    "joints": "one number per joint is written to the completed file, and MuJoCo reads no more; "
    "fix the joints that need not move",
    _BYTES: "give it simpler meshes and smaller pictures",
}
_MOST_OF = {  # attributes of other elements
    ("size", "memory"): 2**30,
    ("size", "nuserdata"): 1e6,
    ("size", "nstack"): 2**27,
    ("size", "njmax"): 1e6,
    ("size", "nconmax"): 1e6,
    ("size", "nkey"): 1e4,
    ("user", "dim"): 1e4,
    ("contact", "num"): 1e4,
} | {
    ("option", f"{kind}{name}"): 1e4
    for kind, name in (
        *((kind, "iterations") for kind in ("", "ls_", "noslip_", "ccd_", "sdf_")),
        ("sdf_", "initpoints"),
    )
}
_MOST_PER_USER = 100  # <size nuser_...>, user="...": numbers that every element of a kind gets
_MOST_SAMPLES = 1e4  # nsample: of the history of a sensor or actuator
_MOST_FOLDERS = 64  # in the name of a file, whose ends are looked for beside and above the file
_MOST_OF_SHAPE = 256  # <mesh builtin params>: segments
_MOST_ATTRIBUTES = 200  # per element; MuJoCo searches them one by one
_LEAST_TIMESTEP = 1e-5  # s
_UNITS = {"K": 2**10, "M": 2**20, "G": 2**30, "T": 2**40, "P": 2**50, "E": 2**60}


def files_of(path: Path) -> dict[str, str]:
    """The files that belong to a robot file, itself included: path -> what changes with a file.

    Raises ValueError, naming the file and the element, if it asks for more than a robot needs or
    leads back to itself; OSError if it cannot be opened.
    """
    survey = _Survey(path)
    _measure(survey, path, ())
    return survey.files


@dataclass
class _Survey:
    """What a robot file asks for, with the files that it names."""

    path: Path
    totals: Counter = field(default_factory=Counter)
    documents: dict[str, float] = field(default_factory=dict)
    """Elements of every document by its path."""
    rays: float = 1
    """Pixels of the camera that has most, each of which can be a ray of a range finder."""
    files: dict[str, str] = field(default_factory=dict)
    """For every file, by its path, a text that changes with the file."""

    def spend(self, what: str, amount: float, place: str) -> None:
        """Add to a total; ValueError if that makes it larger than a robot needs."""
        self.totals[what] += amount
        if not self.totals[what] <= _MOST[what]:  # NaN included
            raise ValueError(too_many(self.path, self.totals[what], what, place))

    def refuse(self, place: str, problem: str) -> None:
        """ValueError about an element of the file."""
        raise ValueError(f"{self.path} cannot be used as a robot: {place} {problem}")


def too_many(path: Path, amount: float, what: str, place: str = "") -> str:
    """The message about a total that is above its limit."""
    most = _MOST.get(what, MAX_NUMBERS)
    advice = _ADVICE.get(what, "which is more than any robot needs; give a file of the robot alone")
    return (
        f"{path} has {amount:,.15g} {what}{place and f' (up to {place})'}: expected at most "
        f"{most:,}; {advice}"
    )


@dataclass
class _Document:
    """An MJCF or URDF file and all that it includes: one model, in which others are attached."""

    folder: Path
    urdf: bool | None = None  # unknown before the first element
    elements: float = 0
    attached: float = 0  # how often models are attached
    models: list[tuple[str, Path]] = field(default_factory=list)
    assets: list[tuple[str, str]] = field(default_factory=list)
    folders: list[str] = field(default_factory=list)  # of assets


def _measure(survey: _Survey, path: Path, trail: tuple[str, ...]) -> float:
    """Number of elements that MuJoCo builds from a file."""
    real = os.path.realpath(path)
    if real not in survey.documents:
        document = _Document(path.absolute().parent)
        trail = _scan(survey, document, path, str(path), trail, 1)
        for place, name in document.assets:
            _weigh(survey, document, place, name)
        sizes = [_measure(survey, file, trail) for _, file in document.models]
        document.elements += document.attached * max(sizes, default=0)
        if not document.elements <= _MOST["elements"]:
            raise ValueError(too_many(survey.path, document.elements, "elements", "all attached"))
        survey.documents[real] = document.elements
    return survey.documents[real]


def _scan(
    survey, document, path: Path, named: str, trail: tuple[str, ...], repeated: float
) -> tuple[str, ...]:
    """Add a file, and those that it includes, to a document; returns the files that led to it.

    `repeated` is how often what includes the file is repeated.
    """
    text = _text(survey, path, named)
    trail = (*trail, os.path.realpath(path))
    parents = [("", repeated)]  # open elements, and how often each is repeated
    for line, kind, tag, attributes in _tags(text):
        place = f"<{tag}> in line {line} of {path.name}"
        if kind == "end":
            del parents[max(1, len(parents) - 1) :]
            continue
        if kind == "bad":
            survey.refuse(f"{path.name}, line {line},", f"has {tag}")
        if document.urdf is None:
            document.urdf = tag == "robot"
        parent, times = parents[-1]
        made = _made(tag, attributes)
        repeated = times * (made if tag == "replicate" else 1)
        new = times * (made if tag in ("composite", "flexcomp") else 1)
        document.elements += new
        if not document.elements <= _MOST["elements"]:
            raise ValueError(too_many(survey.path, document.elements, "elements", place))
        if tag == "composite" or (tag == "joint" and _moves(parent, attributes)):
            survey.spend("joints", new, place)
        _check_numbers(survey, place, tag, attributes)
        if tag in ("include", "model") and "file" in attributes:
            file = _file(survey, document, place, attributes["file"], path.absolute().parent)
            if file and os.path.realpath(file) in trail:
                survey.refuse(place, "reads a file that leads back to itself; remove it")
            if file and tag == "model":
                document.models.append((place, file))
            elif file:
                _scan(survey, document, file, place, trail, times)
        elif tag == "attach":
            document.attached += times
        elif tag == "compiler":
            folders = (attributes.get(f"{kind}dir") for kind in ("mesh", "texture", "asset"))
            document.folders += [folder for folder in folders if folder]
        elif tag == "plugin" and parent == "extension":
            survey.refuse(place, "needs code that is not in the file, and MJX has none; remove it")
        elif tag in ("mesh", "hfield", "texture", "skin", "flexcomp"):
            files = [attributes[name] for name in attributes if name.startswith("file")]
            document.assets += [(place, name) for name in files]
        if kind == "start":
            parents.append((tag, repeated))
            if len(parents) > MAX_DEPTH + 1:
                survey.refuse(place, f"is inside {MAX_DEPTH} others: expected less; merge bodies")
    return trail


_TAG = re.compile(r"<(/?)([^\s<>/=\"'!?]++)")
_ATTRIBUTE = re.compile(r"\s*+([^\s<>/=\"']++)\s*+=\s*+(?:\"([^\"]*+)\"|'([^']*+)')")
_END = re.compile(r"\s*+(/?)>")
_SKIPPED = {"<!--": "-->", "<![CDATA[": "]]>", "<?": "?>", "<!": ">"}


def _tags(text: str) -> Iterator[tuple[int, str, str, dict[str, str]]]:
    """Line, kind (start, empty, end or bad), name or fault, and attributes of the tags of a text.

    Anything that is not a tag is left for MuJoCo to report.
    """
    line, counted, position = 1, 0, 0
    while (position := text.find("<", position)) >= 0:
        line += text.count("\n", counted, position)
        counted = position
        opening = next((word for word in _SKIPPED if text.startswith(word, position)), None)
        if opening:
            after = text.find(_SKIPPED[opening], position + len(opening))
            declaration = text[position:after] if opening == "<!" else ""
            if re.match(r"<!ENTITY|<!DOCTYPE[^\[]*\[", declaration):
                yield line, "bad", "a document type with entities: write out what they say", {}
            if after < 0:
                if opening == "<!--":
                    yield line, "bad", 'a comment that never ends: close it by "-->"', {}
                return
            position = after
            continue
        tag = _TAG.match(text, position)
        if not tag:
            position += 1
            continue
        position, attributes = tag.end(), {}
        while found := _ATTRIBUTE.match(text, position):
            position = found.end()
            value = found[2] if found[3] is None else found[3]
            attributes[found[1]] = html.unescape(value) if "&" in value else value
        end = _END.match(text, position)
        kind = "end" if tag[1] else "empty" if end and end[1] else "start"
        yield line, kind, tag[2], attributes


def _number(text: str) -> float:
    """The first number of a text, with MuJoCo's units of memory; 0 if there is none."""
    found = re.match(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:e[-+]?\d+)?)([KMGTPE]?)", text, re.IGNORECASE)
    return float(found[1]) * _UNITS.get(found[2].upper(), 1) if found else 0.0


def _made(tag: str, attributes: dict[str, str]) -> float:
    """How often an element repeats what is in it, or how many parts it makes."""
    if tag == "flexcomp" and attributes.get("type", "grid") == "grid":
        counts = attributes.get("count", "10 10 10")
    else:
        counts = attributes.get("count", "1")
    return max(1.0, math.prod(max(1.0, _number(count)) for count in counts.split()[:3]))


def _moves(parent: str, attributes: dict[str, str]) -> bool:
    """Whether a <joint> is a joint of a body, not a default, a constraint or a reference to one."""
    if parent == "robot":
        return attributes.get("type") not in ("fixed", "floating")
    return parent in ("body", "frame", "replicate") and attributes.get("type") != "free"


def _check_numbers(survey: _Survey, place: str, tag: str, attributes: dict[str, str]) -> None:
    """Refuse sizes, counts and lists that can only overflow or take forever."""
    if len(attributes) > _MOST_ATTRIBUTES:
        survey.refuse(
            place,
            f"has {len(attributes):,} attributes: expected at most {_MOST_ATTRIBUTES}; remove them",
        )
    if tag == "numeric" and (count := len(attributes.get("data", "").split())) > MAX_NUMBERS:
        survey.refuse(
            place,
            f"holds {count:,} numbers: expected at most {MAX_NUMBERS}, as MuJoCo reads no more; "
            "remove some",
        )
    if tag == "option" and 0 < (step := _number(attributes.get("timestep", ""))) < _LEAST_TIMESTEP:
        survey.refuse(
            place,
            f"has timestep {step:g}: expected at least {_LEAST_TIMESTEP:g} s, as a second takes "
            "hours otherwise; correct it",
        )
    for name, text in attributes.items():
        most = _MOST_OF.get((tag, name))
        if tag == "size" and name.startswith("nuser_"):
            most = _MOST_PER_USER
        if name == "nsample":
            most = _MOST_SAMPLES
        if name == "user" and (count := len(text.split())) > _MOST_PER_USER:
            survey.refuse(
                place,
                f"has {count:,} user numbers: expected at most {_MOST_PER_USER}; remove some",
            )
        numbers = [_number(text)] if most else []
        if tag == "mesh" and name == "params" and "builtin" in attributes:
            most, numbers = _MOST_OF_SHAPE, [_number(part) for part in text.split()]
        if most and not max(numbers, default=0) <= most:
            survey.refuse(
                place, f"has {name}={text[:40]!r}: expected at most {most:,.15g}; correct it"
            )
    if tag == "hfield":
        points = _number(attributes.get("nrow", "")) * _number(attributes.get("ncol", ""))
        survey.spend("points of height fields", max(0.0, points), place)
    if tag == "camera":
        sides = [max(1.0, _number(part)) for part in attributes.get("resolution", "1").split()]
        survey.rays = max(survey.rays, math.prod(sides))
    if tag == "rangefinder" and "camera" in attributes:
        survey.spend("rays of range finders", survey.rays, place)
    if tag == "texture":
        width, height = (_number(attributes.get(name, "")) for name in ("width", "height"))
        if attributes.get("type") != "2d":
            height = max(height, 6 * width)  # six sides
        survey.spend("pixels of textures", max(0.0, width * height), place)


# Files that a robot file names.


def _text(survey: _Survey, path: Path, place: str) -> str:
    survey.spend("bytes of text", _checked(survey, path, place).st_size, place)
    try:
        data = path.read_bytes()
    except OSError:
        if path == survey.path:
            raise
        return ""  # MuJoCo says so, with the place
    survey.files[os.path.realpath(path)] = hashlib.sha256(data).hexdigest()
    return data.decode("utf-8-sig", errors="replace")


def _checked(survey: _Survey, path: Path, place: str) -> os.stat_result:
    """State of a file; ValueError for a pipe or a device, reading which may never end."""
    state = os.stat(path)
    if not stat.S_ISREG(state.st_mode):
        survey.refuse(place, f"reads {path}, which is a pipe or a device: expected a file")
    survey.files[os.path.realpath(path)] = f"{state.st_ino} {state.st_size} {state.st_mtime_ns}"
    return state


def _first(places: Iterable[Path]) -> Path | None:
    """The first place that exists and is not a folder."""
    for place in places:
        try:
            if not stat.S_ISDIR(os.stat(place).st_mode):
                return place
        except (OSError, ValueError):  # nothing there; a name that no file can have
            continue
    return None


def _file(survey, document, place: str, name: str, folder: Path) -> Path | None:
    """The text file that is included or attached under a name in a file of `folder`."""
    _check_name(survey, place, name)
    return _first(start / name for start in (document.folder, folder, Path()))


def _weigh(survey: _Survey, document: _Document, place: str, name: str) -> None:
    """Add the size of a mesh, picture or other asset; a missing file adds nothing."""
    _check_name(survey, place, name)
    folder = document.folder
    parts = Path(name.split("://")[-1]).parts
    starts = [*(folder / start for start in document.folders), folder]
    if document.urdf:  # "package://" names are searched for beside and above the file
        starts = [folder, *folder.parents]
        places = (start.joinpath(*parts[i:]) for start in starts for i in range(len(parts)))
    else:
        names = (name, *parts[-1:])  # <compiler strippath> leaves only the last part
        places = (start / short for short in names for start in starts)
    file = _first(places)
    if file is None or (document.urdf and file.suffix.lower() not in (".stl", ".obj", ".msh")):
        return
    survey.spend(_BYTES, _checked(survey, file, place).st_size, place)
    try:
        with open(file, "rb") as opened:
            head = opened.read(24)
    except OSError:
        return  # missing to MuJoCo too
    if head.startswith(b"\x89PNG") and len(head) == 24:
        width, height = struct.unpack(">II", head[16:])
        survey.spend("pixels of textures", width * height, place)


def _check_name(survey: _Survey, place: str, name: str) -> None:
    if len(name) > 4096:
        survey.refuse(place, f"names a file by {len(name):,} characters; give a shorter name")
    if (count := name.count("/") + name.count("\\")) > _MOST_FOLDERS:
        survey.refuse(place, f"names a file in {count:,} folders; give a shorter name")
