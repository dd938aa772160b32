"""Model folders that appear whole or not at all, and never over a user's models."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pycolmap

from colmap_netvlad.runtime.errors import InputError
from colmap_netvlad.runtime.files import remove_folder, temporary_prefix

Finish = Callable[[Path], None]
"""What is done in a folder of new models before it gets its name: killed in between, there is no
model that lacks it. It may give it a name itself (`take_name`)."""


def as_mapped(folder: Path) -> None:
    """Leave models as the mapper made them: the default `Finish`."""


@contextmanager
def model_folder(output: Path) -> Iterator[Path]:
    """Yield a temporary folder beside `output` that becomes `output` when the block succeeds.

    It keeps a name that the block has given it.

    Raises:
        InputError: `output` holds something already, or cannot be written.
    """
    if output.exists() and (not output.is_dir() or any(output.iterdir())):
        raise InputError(f"{output} exists already and is left as it is; name another `output`.")
    try:
        output.parent.mkdir(parents=True, exist_ok=True)
        prefix = temporary_prefix(output)
        temporary = Path(tempfile.mkdtemp(prefix=prefix, dir=output.parent))
    except OSError as fault:
        raise InputError(f"Cannot write {output}: {fault.strerror or fault}.") from fault
    try:
        yield temporary
        if temporary.exists():
            _rename(temporary, output)
    except OSError as fault:
        raise InputError(f"Cannot write {output}: {fault.strerror or fault}.") from fault
    finally:
        remove_folder(temporary)


def take_name(folder: Path, output: Path) -> Path:
    """Rename a finished folder to the first free one of `output`, `<output>-2`, ...; return that.

    A name that was free before the mapping may be another run's by now.
    """
    while True:
        target = free_output(output)
        try:
            _rename(folder, target)
        except OSError:
            if free_output(output) == target:  # nobody took it: it cannot be written
                raise
        else:
            return target


def _rename(folder: Path, target: Path) -> None:
    folder.chmod(0o755)
    if target.exists():
        target.rmdir()
    folder.rename(target)


def numbered(folder: Path, before: str = "") -> list[Path]:
    """Return what lies in `folder` as `<before>`0, 1, ..., in the order of the numbers."""
    number = {path: path.name.removeprefix(before) for path in folder.glob(f"{before}[0-9]*")}
    found = [path for path, digits in number.items() if digits.isdecimal()]
    return sorted(found, key=lambda path: int(number[path]))


def largest_first(folder: Path) -> list[pycolmap.Reconstruction]:
    """Number the models of a folder anew, the largest first, and return them.

    COLMAP numbers them as it began them: `0`, which users and programs take for the model, may
    be a stray pair of photos.
    """
    paths = numbered(folder)
    models = [pycolmap.Reconstruction(path) for path in paths]
    order = sorted(range(len(models)), key=lambda i: -models[i].num_reg_images())
    if order != list(range(len(models))):
        aside = [path.rename(path.with_name(f"was-{path.name}")) for path in paths]
        for path, i in zip(paths, order, strict=True):
            aside[i].rename(path)
    return [models[i] for i in order]


def named(folder: Path) -> Path:
    """Return a folder by its name, also where the user wrote `.` or `..`: others go beside it."""
    return folder.resolve() if folder.name in ("", "..") else folder


def outputs(output: Path) -> list[Path]:
    """Return those of `output`, `<output>-2`, `-3`, ... that hold something, the newest last."""
    output = named(output)
    candidates = [output, *numbered(output.parent, f"{output.name}-")]
    return [path for path in candidates if path.exists() and not _is_empty(path)]


def _is_empty(path: Path) -> bool:
    return path.is_dir() and not any(path.iterdir())


def free_output(output: Path) -> Path:
    """Return `output`, or `<output>-2`, `-3`, ... where it holds something already.

    A user's models are never replaced: the newest model is the folder with the highest number,
    also where older ones were removed.
    """
    output = named(output)
    taken = outputs(output)
    if not taken:
        return output
    last = taken[-1].name.removeprefix(f"{output.name}-")
    return output.with_name(f"{output.name}-{int(last) + 1 if last.isdecimal() else 2}")
