"""Where things are: the database, the photos, what we keep beside them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

from colmap_netvlad.runtime.errors import InputError

DATABASE_NAMES = ("project.db", "database.db")
"""What a COLMAP workspace calls its database, in the order they are looked for."""


@dataclass(frozen=True)
class Project:
    """A COLMAP workspace: the user's database and photos, and the paths of what we write.

    Attributes:
        database: the COLMAP database; it exists.
        images: the folder that image names are relative to, or None where it is not known
            (methods that need only features still run).
        cache_file: our own file, where it is not to lie beside the database (a read-only
            folder).
    """

    database: Path
    images: Path | None
    cache_file: Path | None = None

    @property
    def folder(self) -> Path:
        """The workspace: the database's folder."""
        return self.database.parent

    @property
    def cache(self) -> Path:
        """Our own sqlite file: descriptors, rankings, settings (`project.netvlad.db`)."""
        return self.cache_file or self.database.with_suffix(".netvlad.db")

    @property
    def copy(self) -> Path:
        """The database that is written instead, where the user's is to stay as it is."""
        return self.database.with_suffix(".copy.db")

    @property
    def pairs(self) -> Path:
        """Where `pairs` writes by default."""
        return self.folder / "pairs.txt"

    @property
    def sparse(self) -> Path:
        """Where COLMAP keeps its models: `sparse/0`, `sparse/1`, ..."""
        return self.folder / "sparse"

    def need_images(self) -> Path:
        """Return the photo folder.

        Raises:
            InputError: it is not known, or not there.
        """
        if self.images is None:
            raise InputError(
                f"No photo folder is known for {self.database}: there is no "
                f"{self.folder / 'images'}; say where the photos are with `images`."
            )
        if not self.images.is_dir():
            raise InputError(f"The photo folder {self.images} does not exist; mend `images`.")
        return self.images


def locate_database(database: Path | None, folder: Path | None = None) -> Path:
    """Find the database: the given one, or `project.db` or `database.db` in `folder`.

    Raises:
        InputError: there is none.
    """
    if database is None:
        folder = folder or Path.cwd()
        found = [folder / name for name in DATABASE_NAMES if (folder / name).is_file()]
        if not found:
            raise InputError(
                f"No {' or '.join(DATABASE_NAMES)} in {folder}; name one with `database`."
            )
        return found[0]
    if not database.exists():
        raise InputError(f"The database {database} does not exist; mend `database`.")
    if database.is_dir():
        raise InputError(f"{database} is a folder; `database` names the database file in it.")
    return database


def open_project(
    database: str | Path | None = None,
    images: str | Path | None = None,
    cache: str | Path | None = None,
) -> Project:
    """Locate a project; nothing is read of its database.

    Args:
        database: the COLMAP database, or None to look in the current folder.
        images: the photo folder; default: the one that the cache remembers, else `images/` beside
            the database where it is a folder.
        cache: our own file, or None for the one beside the database.

    Raises:
        InputError: no database, a photo folder was given that does not exist, or a damaged cache.
    """
    from colmap_netvlad.cache.store import remembered_images

    found = locate_database(None if database is None else Path(database))
    project = Project(found, None, None if cache is None else Path(cache))
    if images is not None:
        folder = Path(images)
        if not folder.is_dir():
            raise InputError(f"The photo folder {folder} does not exist; mend `images`.")
        return replace(project, images=folder)
    for candidate in (remembered_images(project.cache), found.parent / "images"):
        if candidate is not None and candidate.is_dir():
            return replace(project, images=candidate)
    return project
