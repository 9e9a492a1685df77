"""Single-line mutations of numeric Python code: a wrong sign, a factor of two, an index off by one, by its syntax tree.

Only code inside functions is mutated. Left out: docstrings and messages, annotations, decorators, default values,
checks of arguments (functions named `check…` or `require…`, `__post_init__`, an `if` that only raises), assertions.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from dataclasses import dataclass

OPERATORS = {
    ast.Add: ("+", "-"),
    ast.Sub: ("-", "+"),
    ast.Mult: ("*", "/"),
    ast.Div: ("/", "*"),
    ast.BitAnd: ("&", "|"),
    ast.BitOr: ("|", "&"),
    ast.Lt: ("<", "<="),
    ast.LtE: ("<=", "<"),
    ast.Gt: (">", ">="),
    ast.GtE: (">=", ">"),
    ast.Eq: ("==", "!="),
    ast.NotEq: ("!=", "=="),
    ast.And: ("and", "or"),
    ast.Or: ("or", "and"),
}
"""The symbol of an operator, and the one in its place."""

PAIRS = [
    ("minimum", "maximum"), ("min", "max"), ("argmin", "argmax"), ("nanmin", "nanmax"), ("fmin", "fmax"),
    ("any", "all"), ("sin", "cos"), ("floor", "ceil"), ("ones_like", "zeros_like"), ("cumsum", "cumprod"),
]  # fmt: skip
NAMES = {**dict(PAIRS), **{b: a for a, b in PAIRS}}
"""The function in the place of another."""

DROPPED = {"sqrt", "abs", "square", "exp", "log"}
"""Functions of one argument in whose place the argument stands."""

SWAPPED = {"where": 1, "arctan2": 0, "outer": 0, "searchsorted": 0}
"""The first of two positional arguments that change places."""

SIDES = {"left": "right", "right": "left"}
UNTOUCHED_CALLS = {"field", "isinstance", "hasattr", "getattr", "Channel", "namedtuple", "TypeVar", "cast"}
CHECKS = ("check", "_check", "require", "_require", "__post_init__", "__check_init__", "__repr__")


@dataclass(frozen=True)
class Mutation:
    """A mutation of one line: `kind` in words, the line's number, its text before and after."""

    file: str
    line: int
    kind: str
    before: str
    after: str

    def applied(self, source: str) -> str:
        """The file's text with this mutation."""
        lines = source.split("\n")
        assert lines[self.line - 1] == self.before
        lines[self.line - 1] = self.after
        return "\n".join(lines)


def mutations(file: str, source: str) -> list[Mutation]:
    """All mutations of a file's text, by line and column."""
    found = []
    lines = source.split("\n")
    for line, start, end, text, kind in _edits(ast.parse(source), lines):
        # Columns of the syntax tree count bytes.
        before = lines[line - 1].encode()
        after = (before[:start] + text.encode() + before[end:]).decode()
        if after != before.decode():
            found.append((line, start, Mutation(file, line, kind, before.decode(), after)))
    return [mutation for _, _, mutation in sorted(found, key=lambda x: (x[0], x[1], x[2].after))]


Edit = tuple[int, int, int, str, str]
"""Line, first column, last column, new text, kind."""


def _edits(tree: ast.AST, lines: list[str]) -> Iterator[Edit]:
    for node in _numeric(tree, inside=False):
        if getattr(node, "lineno", None) != getattr(node, "end_lineno", None) and not isinstance(
            node, ast.BinOp | ast.BoolOp | ast.Compare | ast.Call
        ):
            continue
        if isinstance(node, ast.BinOp):
            yield from _binary(node, lines)
        elif isinstance(node, ast.BoolOp):
            for left, right in zip(node.values[:-1], node.values[1:], strict=True):
                yield from _operator(left, node.op, right, lines)
        elif isinstance(node, ast.Compare):
            left = node.left
            for op, right in zip(node.ops, node.comparators, strict=True):
                yield from _operator(left, op, right, lines)
                left = right
        elif isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub | ast.Not | ast.Invert):
            if not isinstance(node.operand, ast.Constant):
                yield _whole(node, _text(node.operand, lines), "sign or negation dropped")
        elif isinstance(node, ast.Call):
            yield from _call(node, lines)
        elif isinstance(node, ast.Subscript):
            yield from _index(node)
        elif isinstance(node, ast.AugAssign) and not isinstance(node.op, ast.BitOr):
            yield from _operator(node.target, node.op, node.value, lines)
        elif isinstance(node, ast.Constant):
            yield from _constant(node)


def _numeric(node: ast.AST, inside: bool) -> Iterator[ast.AST]:
    """The nodes below one that may be mutated; `inside`: of a function's body."""
    if isinstance(node, ast.FunctionDef):
        if not node.name.startswith(CHECKS):
            for statement in node.body:
                yield from _numeric(statement, True)
        return
    if isinstance(node, ast.Raise | ast.Assert | ast.JoinedStr | ast.Import | ast.ImportFrom):
        return
    if isinstance(node, ast.AnnAssign):
        if node.value is not None:
            yield from _numeric(node.value, inside)
        return
    if isinstance(node, ast.If) and all(isinstance(s, ast.Raise) for s in node.body):
        for statement in node.orelse:
            yield from _numeric(statement, inside)
        return
    if isinstance(node, ast.Call) and _name(node.func) in UNTOUCHED_CALLS:
        return
    if inside:
        yield node
    skipped = _indices(node) | _axes(node)
    for child in ast.iter_child_nodes(node):
        # An index and an axis are numbers of their own kind, and mutated with what they belong to.
        if id(child) not in skipped and not isinstance(child, ast.arguments):
            yield from _numeric(child, inside)


def _indices(node: ast.AST) -> set[int]:
    if not isinstance(node, ast.Subscript):
        return set()
    parts = [node.slice, *(node.slice.elts if isinstance(node.slice, ast.Tuple) else [])]
    return {id(part) for part in parts if _integer(part) is not None}


def _axes(node: ast.AST) -> set[int]:
    if not isinstance(node, ast.Call):
        return set()
    return {id(k) for k in node.keywords if k.arg == "axis" and _integer(k.value) is not None}


def _binary(node: ast.BinOp, lines: list[str]) -> Iterator[Edit]:
    yield from _operator(node.left, node.op, node.right, lines)
    if isinstance(node.op, ast.Add | ast.Sub | ast.Mult) and node.lineno == node.end_lineno:
        kept = _text(node.left, lines)
        yield _whole(node, kept, "factor dropped" if isinstance(node.op, ast.Mult) else "term dropped")


def _operator(left: ast.expr, op: ast.AST, right: ast.expr, lines: list[str]) -> Iterator[Edit]:
    """The operator's edit, where it stands on one line with both operands' nearer ends."""
    if type(op) not in OPERATORS or left.end_lineno != right.lineno or left.end_col_offset is None:
        return
    between = lines[right.lineno - 1].encode()[left.end_col_offset : right.col_offset].decode()
    symbol, new = OPERATORS[type(op)]
    at = between.find(symbol)
    if at >= 0:
        start = left.end_col_offset + at
        yield right.lineno, start, start + len(symbol), new, f"{symbol} to {new}"


def _call(node: ast.Call, lines: list[str]) -> Iterator[Edit]:
    name, func, args = _name(node.func), node.func, node.args
    if name in NAMES and func.end_col_offset is not None and func.end_lineno is not None:
        start = func.end_col_offset - len(name)
        yield func.end_lineno, start, func.end_col_offset, NAMES[name], f"{name} to {NAMES[name]}"
    for keyword in node.keywords:
        axis = _integer(keyword.value) if keyword.arg == "axis" else None
        if axis is not None:
            yield _whole(keyword.value, "1" if axis == 0 else "0" if axis > 0 else str(axis - 1), "axis changed")
        side = keyword.value.value if isinstance(keyword.value, ast.Constant) else None
        if keyword.arg == "side" and side in SIDES:
            yield _whole(keyword.value, f'"{SIDES[str(side)]}"', "side changed")
    if node.lineno != node.end_lineno:
        return
    if name in DROPPED and len(args) == 1 and not node.keywords:
        yield _whole(node, _text(args[0], lines), f"{name} dropped")
    first = SWAPPED.get(name, 0 if name[:1].isupper() else None)
    if first is not None and len(args) > first + 1 and not any(isinstance(a, ast.Starred) for a in args):
        a, b = args[first], args[first + 1]
        if ast.dump(a) != ast.dump(b) and not any(isinstance(x, ast.Constant) and x.value is None for x in (a, b)):
            text = lines[node.lineno - 1].encode()
            assert a.end_col_offset is not None
            assert b.end_col_offset is not None
            between = text[a.end_col_offset : b.col_offset].decode()
            swapped = _source(b, lines) + between + _source(a, lines)
            yield node.lineno, a.col_offset, b.end_col_offset, swapped, "arguments swapped"


def _index(node: ast.Subscript) -> Iterator[Edit]:
    wanted = _indices(node)
    for part in (p for p in ast.walk(node.slice) if isinstance(p, ast.expr)):
        value = _integer(part) if id(part) in wanted else None
        if value is not None:
            new = value + 1 if value >= 0 else value - 1
            yield _whole(part, str(new), "index off by one")
            if value > 0:
                yield _whole(part, str(value - 1), "index off by one")


def _constant(node: ast.Constant) -> Iterator[Edit]:
    value = node.value
    if isinstance(value, float):
        yield _whole(node, repr(2 * value if value else 1.0), "constant changed")
    elif isinstance(value, int) and not isinstance(value, bool):
        yield _whole(node, str(2 * value if value else 1), "constant changed")


def _integer(node: ast.AST) -> int | None:
    """The value of an integer literal with or without a minus; None for anything else."""
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
        value = _integer(node.operand)
        return None if value is None else -value
    if isinstance(node, ast.Constant) and isinstance(node.value, int) and not isinstance(node.value, bool):
        return node.value
    return None


def _name(func: ast.expr) -> str:
    return func.attr if isinstance(func, ast.Attribute) else func.id if isinstance(func, ast.Name) else ""


def _whole(node: ast.expr, text: str, kind: str) -> Edit:
    assert node.end_col_offset is not None
    return node.lineno, node.col_offset, node.end_col_offset, text, kind


def _source(node: ast.expr, lines: list[str]) -> str:
    return lines[node.lineno - 1].encode()[node.col_offset : node.end_col_offset].decode()


def _text(node: ast.expr, lines: list[str]) -> str:
    """The source of an expression on one line, in parentheses unless it is a name, a number, a call or an index."""
    source = _source(node, lines)
    atom = isinstance(node, ast.Name | ast.Constant | ast.Call | ast.Attribute | ast.Subscript)
    return source if atom else f"({source})"
