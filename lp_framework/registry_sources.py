"""The registered classes of this package, read from its sources without running them.

So `lp plugins` and the overview answer at once, though the classes themselves need torch and more.
"""

from __future__ import annotations

import ast
import typing
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from lp_framework.errors import UserError

GROUPS = ("model", "backbone", "prior", "solver", "start", "data", "renderer", "figure")
BUILT_IN = "built-in"
PACKAGE = "lp_framework"

Key = tuple[str, str]  # group, name


@dataclass(frozen=True)
class Argument:
    """One argument of a constructor, as text; `default` is None where a value has to be given."""

    name: str
    annotation: str
    default: str | None

    def __str__(self) -> str:
        return self.name if self.default is None else f"{self.name}={self.default}"


@dataclass(frozen=True)
class Entry:
    """What is known of a registered class without using it."""

    group: str
    name: str
    module: str
    qualname: str
    origin: str
    summary: str
    settings: tuple[Argument, ...]
    components: tuple[Argument, ...]


@cache
def built_ins() -> dict[Key, Entry]:
    """The classes of this package that are decorated with `@register("group", "name")`, found without importing."""
    found: dict[Key, Entry] = {}
    for file in sorted(Path(__file__).parent.rglob("*.py")):
        text = file.read_text(encoding="utf-8")
        if "@register(" not in text:
            continue
        for node in syntax_tree(file).body:
            for key in _registrations(node):
                if key in found:
                    raise UserError(f"{key[0]} '{key[1]}' is registered twice: in {found[key].module} and in {file}")
                found[key] = _describe(key, file, typing.cast(ast.ClassDef, node))
    return found


@cache
def syntax_tree(file: Path) -> ast.Module:
    """What a source file says."""
    return ast.parse(file.read_text(encoding="utf-8"), str(file))


def _registrations(node: ast.stmt) -> Iterator[Key]:
    """The (group, name) pairs of the `register` decorators on a class."""
    for decorator in node.decorator_list if isinstance(node, ast.ClassDef) else ():
        match decorator:
            case ast.Call(
                func=ast.Name(id="register") | ast.Attribute(attr="register"),
                args=[ast.Constant(value=str(group)), ast.Constant(value=str(name))],
            ):
                yield group, name


def _describe(key: Key, file: Path, node: ast.ClassDef) -> Entry:
    found = constructor_of(file, node.name)
    arguments = _signature(*found) if found else []
    return Entry(
        *key,
        _module_name(file),
        node.name,
        BUILT_IN,
        first_line(ast.get_docstring(node)),
        tuple(each for each in arguments if each.name not in GROUPS),
        tuple(each for each in arguments if each.name in GROUPS),
    )


def _module_name(file: Path) -> str:
    parts = file.relative_to(Path(__file__).parents[1]).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def constructor_of(file: Path, name: str) -> tuple[Path, ast.FunctionDef] | None:
    """The `__init__` of a class in a source file and the file that it is in: the class's own, or that of the first base
    class in this package that has one."""
    found = _class_named(file, name)
    if found is None:
        return None
    file, node = found
    for statement in node.body:
        if isinstance(statement, ast.FunctionDef) and statement.name == "__init__":
            return file, statement
    for base in node.bases:
        inherited = constructor_of(file, base.id) if isinstance(base, ast.Name) else None
        if inherited is not None:
            return inherited
    return None


def source_file(module: str) -> Path:
    """The source of a module of this package."""
    source = Path(__file__).parents[1].joinpath(*module.split("."))
    return source / "__init__.py" if source.is_dir() else source.with_suffix(".py")


def _class_named(file: Path, name: str) -> tuple[Path, ast.ClassDef] | None:
    """The class that a name means at the top level of a source file, followed through imports from this package."""
    for statement in syntax_tree(file).body:
        if isinstance(statement, ast.ClassDef) and statement.name == name:
            return file, statement
        if isinstance(statement, ast.ImportFrom) and (statement.module or "").startswith(f"{PACKAGE}."):
            for alias in statement.names:
                if (alias.asname or alias.name) == name:
                    return _class_named(source_file(typing.cast(str, statement.module)), alias.name)
    return None


def _signature(file: Path, constructor: ast.FunctionDef) -> list[Argument]:
    arguments = constructor.args
    positional = [*arguments.posonlyargs, *arguments.args]
    defaults = [*[None] * (len(positional) - len(arguments.defaults)), *arguments.defaults]
    pairs = [*zip(positional, defaults, strict=True), *zip(arguments.kwonlyargs, arguments.kw_defaults, strict=True)]
    return [
        Argument(
            each.arg,
            ast.unparse(each.annotation).strip("'") if each.annotation else "",
            None if default is None else ast.unparse(_value(file, default)),
        )
        for each, default in pairs[1:]  # without self
    ]


def _value(file: Path, default: ast.expr) -> ast.expr:
    """The default itself, or the value of the constant that it names: of `A = 1` or `A, B = 1, 2` in the same file."""
    for statement in syntax_tree(file).body:
        match statement:
            case ast.Assign(targets=[ast.Name(id=name)], value=value):
                constants = {name: value}
            case ast.Assign(targets=[ast.Tuple(elts=names)], value=ast.Tuple(elts=values)):
                constants = {
                    each.id: value for each, value in zip(names, values, strict=False) if isinstance(each, ast.Name)
                }
            case _:
                continue
        if isinstance(default, ast.Name) and default.id in constants:
            return constants[default.id]
    return default


def first_line(docstring: str | None) -> str:
    """The first line of a docstring, or nothing."""
    return (docstring or "").strip().partition("\n")[0]
