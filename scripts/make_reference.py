"""Write the reference pages of the docs from the code they describe.

    python scripts/make_reference.py

`docs/commands.md` comes from the command line itself, `docs/python.md` lists the public names of
the package and the options and reports that they take and return; mkdocstrings puts their
docstrings there. `tests/test_docs.py` fails where a committed page is not what this script makes.
"""

from __future__ import annotations

import dataclasses
import inspect
import types
import typing
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click

import colmap_netvlad
from colmap_netvlad.cli import cli

DOCS = Path(__file__).parents[1] / "docs"

STEPS = ("open_project", "import_photos", "make_pairs", "match", "reconstruct", "add_photos")
"""Public functions in the order of the work; the rest follows."""

MAIN = ("features", "pairs", "match", "reconstruct", "add", "compare", "viewgraph", "methods")
"""Commands in the order of the work; the rest follows as the command line has it."""

COMMANDS_HEAD = """\
# All commands

<!-- Made by scripts/make_reference.py from the command line itself; do not edit. -->

`colmap-netvlad COMMAND --help` shows the same. COLMAP's own option names (`--database_path`,
`--image_path`, `--output_path`) work wherever they stand here. What the exit codes mean and how to
let the shell complete commands: [scripting](scripting.md).
"""

PYTHON_HEAD = """\
# Python reference

<!-- Made by scripts/make_reference.py from the package itself; do not edit. -->

```python
import colmap_netvlad as cn

if __name__ == "__main__":
    project = cn.open_project("project.db", images="photos")
    pairs = cn.make_pairs(project, k=30)
    model = cn.reconstruct(project, pairs)
    page = cn.compare(project, methods=["bow", "vlad", "netvlad-o-lite"], k=[10, 20])
```

The line with `__main__` is needed in a script: processes that share the work import the file again,
and would begin it anew without. Each command is one function. They raise `InputError` with one
sentence where something in the input is wrong, log through `logging`, and print nothing. Importing
before or after pycolmap makes no difference. A walk through them on a rendered flight:
`examples/walkthrough.py`. What is not shown here is not promised to stay. (On a repository page
only names show; the site has the docstrings.)
"""


def commands_page() -> str:
    """Return the page of all commands."""
    context = click.Context(cli, info_name="colmap-netvlad")
    commands = {name: cli.commands[name] for name in dict.fromkeys((*MAIN, *cli.commands))}
    overview = [
        f"- [`{name}`](#{name}): {_sentence(command)}" for name, command in commands.items()
    ]
    sections = [_section(name, command, context) for name, command in commands.items()]
    return "\n".join([COMMANDS_HEAD, *overview, "", *sections]).rstrip() + "\n"


def _sentence(command: click.Command) -> str:
    first = inspect.cleandoc(command.help or "").split("\n\n")[0]
    return " ".join(first.split())


def _section(name: str, command: click.Command, parent: click.Context) -> str:
    context = click.Context(command, info_name=name, parent=parent)
    parameters = command.get_params(context)
    arguments = [_argument(p) for p in parameters if isinstance(p, click.Argument)]
    usage = " ".join(["colmap-netvlad", name, "[OPTIONS]", *arguments])
    rows = [
        f"| {_flags(option)} | {_meaning(option)} |"
        for option in parameters
        if isinstance(option, click.Option) and "--help" not in option.opts
    ]
    table = ["| option | meaning |", "|---|---|", *rows, ""] if rows else []
    text = inspect.cleandoc(command.help or "")
    return "\n".join([f"## {name}", "", f"    {usage}", "", text, "", *table])


def _argument(argument: click.Argument) -> str:
    return f"{argument.human_readable_name}{'...' if argument.nargs != 1 else ''}"


def _flags(option: click.Option) -> str:
    names = ", ".join(f"`{name}`" for name in option.opts)
    if option.secondary_opts:
        names += " / " + ", ".join(f"`{name}`" for name in option.secondary_opts)
    if option.is_flag:
        return names
    # Click words ranges in its own way from version to version; a kind is enough here.
    if isinstance(option.type, click.Choice):
        return f"{names} " + ", ".join(f"`{choice}`" for choice in option.type.choices)
    kind = option.type.name.removesuffix(" range").upper()
    return f"{names} `{kind}`"


def _meaning(option: click.Option) -> str:
    text, _, default = (option.help or "").partition("  [default: ")
    text = text.replace("|", "\\|").replace("<", "&lt;").replace("*", "\\*")
    if default:
        return f"{text} Default: {default.removesuffix(']')}."
    if option.required:
        return f"{text} Required."
    if option.multiple:
        return f"{text} May be repeated."
    if option.show_default and option.default is not None:
        value = option.default
        if isinstance(value, bool) and option.secondary_opts:
            value = (option.opts if value else option.secondary_opts)[0]
        return f"{text} Default: `{value}`."
    return text


def python_page() -> str:
    """Return the page of the public functions, and of the classes they take and return."""
    names = dict.fromkeys((*STEPS, *colmap_netvlad.__all__))
    public = [getattr(colmap_netvlad, name) for name in names]
    functions = [thing for thing in public if not inspect.isclass(thing)]
    classes = {thing for thing in public if inspect.isclass(thing)}
    for function in functions:
        classes.update(_classes(function))
    lines = [PYTHON_HEAD, "## Functions", ""]
    lines += [_directive(function) for function in functions]
    lines += ["## What they take and return", ""]
    lines += [_directive(found) for found in sorted(classes, key=lambda found: found.__name__)]
    return "\n".join(lines).rstrip() + "\n"


def _directive(thing: Any) -> str:
    return f"::: {thing.__module__}.{thing.__qualname__}\n"


def _classes(function: Any) -> Iterator[type]:
    """Yield the package's dataclasses that a function's signature names, and those within."""
    waiting, seen = [typing.get_type_hints(function)], set[type]()
    while waiting:
        for hint in waiting.pop().values():
            for kind in _parts(hint):
                ours = inspect.isclass(kind) and kind.__module__.startswith(colmap_netvlad.__name__)
                if ours and dataclasses.is_dataclass(kind) and kind not in seen:
                    seen.add(kind)
                    waiting.append(typing.get_type_hints(kind))
                    yield kind


def _parts(hint: Any) -> Iterator[Any]:
    """Yield the types that a hint such as `list[X] | None` is made of."""
    if isinstance(hint, types.UnionType) or typing.get_origin(hint) is not None:
        for part in typing.get_args(hint):
            yield from _parts(part)
    else:
        yield hint


PAGES = {"commands.md": commands_page, "python.md": python_page}


def main() -> None:
    for name, page in PAGES.items():
        (DOCS / name).write_text(page(), encoding="utf-8")
        print(f"Written: {DOCS / name}")


if __name__ == "__main__":
    main()
