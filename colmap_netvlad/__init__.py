"""Deep image pair retrieval for COLMAP on drone flights.

    import colmap_netvlad as cn

    if __name__ == "__main__":  # processes that share the work import a script again
        project = cn.open_project("project.db", images="photos")
        pairs = cn.make_pairs(project, k=30)
        model = cn.reconstruct(project, pairs)

Each name below is one step; nothing is imported before it is used.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from colmap_netvlad.runtime.libraries import keep_zlib_apart, wait_without_spinning
from colmap_netvlad.runtime.version import VERSION

if TYPE_CHECKING:
    from colmap_netvlad.commands.add import add_photos
    from colmap_netvlad.commands.compare import compare
    from colmap_netvlad.commands.features import import_photos
    from colmap_netvlad.commands.match import match
    from colmap_netvlad.commands.pairs import make_pairs
    from colmap_netvlad.commands.reconstruct import reconstruct
    from colmap_netvlad.graph.viewgraph import read_view_graph
    from colmap_netvlad.project import open_project
    from colmap_netvlad.retrieval.options import RetrievalOptions
    from colmap_netvlad.runtime.cluster import on_cluster
    from colmap_netvlad.runtime.errors import InputError
    from colmap_netvlad.runtime.progress import report_to

__version__ = VERSION

__all__ = [
    "InputError",
    "RetrievalOptions",
    "add_photos",
    "compare",
    "import_photos",
    "make_pairs",
    "match",
    "on_cluster",
    "open_project",
    "read_view_graph",
    "reconstruct",
    "report_to",
]

_HOMES = {
    "InputError": "runtime.errors",
    "RetrievalOptions": "retrieval.options",
    "add_photos": "commands.add",
    "compare": "commands.compare",
    "import_photos": "commands.features",
    "make_pairs": "commands.pairs",
    "match": "commands.match",
    "on_cluster": "runtime.cluster",
    "open_project": "project",
    "read_view_graph": "graph.viewgraph",
    "reconstruct": "commands.reconstruct",
    "report_to": "runtime.progress",
}
"""Where each public name lives (PEP 562: looked up when it is first used)."""

wait_without_spinning()
keep_zlib_apart()


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
