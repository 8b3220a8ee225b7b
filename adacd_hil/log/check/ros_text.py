"""The text of a ros2msg schema: the .msg text of a type, followed by those of the types that it is made of."""

import re

from adacd_hil.log.cdr import SEPARATOR

_PRIMITIVES = {
    *("bool", "byte", "char", "string", "wstring", "float32", "float64"),
    *(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)),
}
_LINE = re.compile(
    r"(?P<type>[A-Za-z][A-Za-z0-9_]*(/[A-Za-z][A-Za-z0-9_]*){0,2})(<=\d+)?(?P<array>\[(<=)?\d*\])?"
    r"\s+(?P<name>[A-Za-z]\w*)\s*(?P<rest>.*)"
)
_CONSTANT = re.compile(r"=\s*\S.*")


def text_problem(data: bytes) -> str:
    """Say what is wrong with the text of a schema; "" when it can be read."""
    try:
        text = data.decode("utf-8")
    except UnicodeDecodeError:
        return "is not UTF-8"
    first, *others = re.split(rf"^={{{len(SEPARATOR)}}}$\n?", text, flags=re.MULTILINE)
    types = {"": first}
    for other in others:
        head, _, body = other.partition("\n")
        if not head.startswith("MSG: "):
            return f"a type has no name: {head!r}"
        types[head.removeprefix("MSG: ").strip()] = body
    known = {_short(name) for name in types}
    for name, body in types.items():
        for line in body.splitlines():
            if problem := _line_problem(line.strip(), known):
                return f"{name or 'the type'}: {problem}"
    return ""


def _line_problem(line: str, known: set[str]) -> str:
    if not line or line.startswith("#"):
        return ""
    match = _LINE.fullmatch(line)
    if match is None:
        return f"no field: {line!r}"
    rest = match["rest"]
    if rest.startswith("=") and not (_CONSTANT.fullmatch(rest) and match["type"] in _PRIMITIVES):
        return f"no constant: {line!r}"
    if match["type"] in _PRIMITIVES or _short(match["type"]) in known:
        return ""
    names = {name.rsplit("/")[-1] for name in known}
    return "" if "/" not in match["type"] and match["type"] in names else f"unknown type {match['type']}"


def _short(name: str) -> str:
    """Spell package/msg/Type as package/Type."""
    parts = name.split("/")
    return f"{parts[0]}/{parts[-1]}" if len(parts) > 1 else name
