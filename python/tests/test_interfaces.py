# SPDX-License-Identifier: MIT OR Apache-2.0
"""Stubs, annotations and docstrings against the module as it is."""

import ast
import subprocess
import sys
from pathlib import Path

import fourdbody as fb
import pytest

PACKAGE = Path(fb.__file__).parent


def test_stubs_and_annotations_agree_with_the_module():
    pytest.importorskip("mypy")
    for tool in (["mypy.stubtest", "fourdbody"], ["mypy", "--strict", "--allow-any-generics", "--no-warn-return-any", "-p", "fourdbody"]):
        ran = subprocess.run([sys.executable, "-m", *tool], capture_output=True, text=True, cwd="/")
        assert ran.returncode == 0, ran.stdout + ran.stderr
    assert (PACKAGE / "py.typed").exists()


def is_text(node):
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)


def documented(body, owner, within=False):
    """Each public name of a class or a function's body, with its documentation: the string behind it."""
    for node, after in zip(body, [*body[1:], None]):
        if isinstance(node, (ast.ClassDef, ast.FunctionDef)) and not node.name.startswith("_"):
            yield f"{owner}.{node.name}", ast.get_docstring(node), node
        elif isinstance(node, (ast.AnnAssign, ast.Assign)):
            target = node.target if isinstance(node, ast.AnnAssign) else node.targets[0]
            # What an `__init__` keeps for itself are attributes of `self`.
            name = target.attr if isinstance(target, ast.Attribute) else "_" if within else getattr(target, "id", "_")
            if not name.startswith("_"):
                yield f"{owner}.{name}", after.value.value if after is not None and is_text(after) else None, node
        if isinstance(node, ast.ClassDef) and node.name in fb.__all__:
            yield from documented(node.body, node.name)
        if isinstance(node, ast.FunctionDef) and node.name == "__init__":
            yield from documented(node.body, owner, True)


def public():
    for path in sorted(PACKAGE.glob("*.py")):
        for name, text, node in documented(ast.parse(path.read_text()).body, path.stem):
            owner, last = name.split(".")
            if owner in fb.__all__ or last in fb.__all__:
                yield name, text, node


def test_every_public_name_has_its_documentation():
    names = dict((name, text) for name, text, _ in public())
    assert not [name for name, text in names.items() if not text]
    assert {name.split(".")[1] for name in names} >= set(fb.__all__)


def test_arrays_state_their_type_as_annotated():
    """What is annotated as one array has the array's type in its documentation, where it has a simple one."""
    checked = 0
    for name, text, node in public():
        annotation = getattr(node, "returns", None) or getattr(node, "annotation", None)
        of = ast.unparse(annotation) if annotation else ""
        if of.startswith("NDArray[np.") and "void" not in of:
            kind = of.split("np.")[1].split("]")[0]
            assert kind in text, f"{name}: annotated as {kind}, documented as {text!r}"
            checked += 1
    assert checked > 12
