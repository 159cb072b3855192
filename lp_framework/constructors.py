"""Constructors of this package's registered classes, made from their sources: to know a class's settings, with types
and defaults, nothing that it imports is needed, above all not torch and Lightning, which take seconds.
"""

from __future__ import annotations

import ast
import builtins
import importlib
import sys
from functools import cache
from pathlib import Path
from typing import Any

from lp_framework.registry_sources import GROUPS, PACKAGE, Key, built_ins, constructor_of, source_file, syntax_tree


class _Unresolved(Exception):
    """A name in a signature that only running the module would explain."""


@cache
def outline(key: Key) -> type | None:
    """A class with the name and the constructor's settings (types, defaults; no components) of a built-in one.

    None for a class that is no built-in, and where a type or a default is more than names, literals and calls of the
    standard library; then the class itself is to be asked.
    """
    entry = built_ins().get(key)
    if entry is None:
        return None
    found = constructor_of(source_file(entry.module), entry.qualname)
    if found is None:
        return type(entry.qualname, (), {})
    file, function = found
    kept = _without_components(function.args)
    namespace: dict[str, Any] = {}
    try:
        for each in ast.walk(kept):
            if isinstance(each, ast.Name):
                namespace[each.id] = _value(file, each.id)
    except _Unresolved:
        return None
    stub = ast.FunctionDef("__init__", kept, [ast.Pass()], [])
    module = ast.fix_missing_locations(ast.Module([stub], []))
    exec(compile(module, str(file), "exec"), namespace)  # of this package's own source
    return type(entry.qualname, (), {"__init__": namespace["__init__"]})


def _without_components(arguments: ast.arguments) -> ast.arguments:
    """A copy of a signature without the arguments that are named after a group."""
    positional = [*arguments.posonlyargs, *arguments.args]
    defaults: list[ast.expr | None] = [*[None] * (len(positional) - len(arguments.defaults)), *arguments.defaults]
    pairs = [pair for pair in zip(positional, defaults, strict=True) if pair[0].arg not in GROUPS]
    named = [
        pair for pair in zip(arguments.kwonlyargs, arguments.kw_defaults, strict=True) if pair[0].arg not in GROUPS
    ]
    return ast.arguments(
        posonlyargs=[],
        args=[argument for argument, _ in pairs],
        kwonlyargs=[argument for argument, _ in named],
        kw_defaults=[default for _, default in named],
        defaults=[default for _, default in pairs if default is not None],
    )


@cache
def _value(file: Path, name: str) -> Any:
    """What a name means at the top level of a source file of this package."""
    for statement in syntax_tree(file).body:
        match statement:
            case ast.Import(names=names):
                for alias in names:
                    if (alias.asname or alias.name) == name and alias.name in sys.stdlib_module_names:
                        return importlib.import_module(alias.name)
            case ast.ImportFrom(module=str(module), names=names):
                for alias in names:
                    if (alias.asname or alias.name) != name:
                        continue
                    if module.partition(".")[0] == PACKAGE:
                        return _value(source_file(module), alias.name)
                    if module.partition(".")[0] in sys.stdlib_module_names:
                        return getattr(importlib.import_module(module), alias.name)
            case ast.Assign(targets=[ast.Name(id=found)], value=value) if found == name:
                return _evaluated(file, value)
            case ast.Assign(targets=[ast.Tuple(elts=names)], value=ast.Tuple(elts=values)):
                for target, value in zip(names, values, strict=False):
                    if isinstance(target, ast.Name) and target.id == name:
                        return _evaluated(file, value)
    if hasattr(builtins, name):
        return getattr(builtins, name)
    raise _Unresolved(name)


def _evaluated(file: Path, value: ast.expr) -> Any:
    names = {each.id: _value(file, each.id) for each in ast.walk(value) if isinstance(each, ast.Name)}
    return eval(compile(ast.Expression(value), str(file), "eval"), names)
