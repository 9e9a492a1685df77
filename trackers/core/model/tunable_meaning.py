"""The meaning of each tunable of a tracker, read from the docstring of the class that declares it."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

import jax

from trackwright.trackers.core.model.state import path_name
from trackwright.trackers.core.model.tunable import is_tunable


def meanings(tree: Any) -> dict[str, str]:
    """A sentence on every tunable of the tree by its dotted name; empty where no docstring mentions it.

    It is the first sentence with the name of the field in backticks, of a list its own part, in the docstring of the
    innermost object around the tunable that has one.
    """
    found = {}
    for path, node in jax.tree_util.tree_flatten_with_path(tree, is_leaf=is_tunable)[0]:
        if is_tunable(node):
            owners = list(_owners(tree, path))
            sentences = (_sentence(owner, owners[-1][1]) for owner, _ in reversed(owners))
            found[path_name(path)] = next(filter(None, sentences), "")
    return found


def _owners(tree: Any, path: tuple[Any, ...]) -> Iterator[tuple[Any, str]]:
    """The objects on the way to a leaf, each with the name of the field in which the way goes on."""
    for key in path:
        if isinstance(key, jax.tree_util.GetAttrKey):
            yield tree, key.name
            tree = getattr(tree, key.name)
        else:
            tree = tree[key.key if isinstance(key, jax.tree_util.DictKey) else key.idx]


def _sentence(owner: Any, name: str) -> str:
    """The first sentence of the docstrings of an object's class and its bases that names the field."""
    for kind in type(owner).__mro__:
        text = " ".join((kind.__dict__.get("__doc__") or "").split())
        for sentence in re.split(r"(?<=\.) (?=[A-Z`])", text):
            if f"`{name}`" in sentence:
                # A list of `name`: meaning; `other`: meaning.
                clauses = [clause for clause in sentence.split("; ") if re.match(rf"(`\w+`, )*`{name}`", clause)]
                found = (clauses or [sentence])[0].rstrip(".")
                if not re.fullmatch(rf"`{name}`: as in `\w+`", found):
                    return found.replace("`", "")
    return ""
