"""Options that several commands share, each worded once, in bundles.

A bundle is a decorator: it adds its options to a command and hands them over as the dataclass
that the library takes (`project`, `retrieval`, `features`, ...).
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click
from click.core import ParameterSource

from colmap_netvlad.matching.options import MATCHER_DEFAULT, MatchOptions
from colmap_netvlad.retrieval.options import COMPARED, GPS_MODES, HIGHEST_SEED, RetrievalOptions
from colmap_netvlad.terminal import VERBOSE

if TYPE_CHECKING:
    from colmap_netvlad.colmap.features import FeatureOptions

Function = TypeVar("Function", bound=Callable[..., Any])
Decorator = Callable[[Callable[..., Any]], Callable[..., Any]]

PATH = click.Path(path_type=Path)
FILE = click.Path(path_type=Path, dir_okay=False)
FOLDER = click.Path(path_type=Path, file_okay=False)

database_option = click.option(
    "--db",
    "--database_path",
    "database",
    type=PATH,
    help="COLMAP database.  [default: project.db or database.db in the current folder]",
)
images_option = click.option(
    "--images",
    "--image_path",
    "images",
    type=PATH,
    help="Folder that image names are relative to."
    "  [default: the folder used last, else images/ beside the database]",
)
cache_option = click.option(
    "--cache",
    type=PATH,
    help="Our own file of descriptors and of what was compared.  [default: project.netvlad.db"
    " beside the database]",
)
output_option = functools.partial(click.option, "--output", "--output_path", "output", type=PATH)
k_option = click.option(
    "--k", default=30, show_default=True, help="Partners retrieved for each image."
)
method_option = click.option(
    "--method",
    default="hybrid",
    show_default=True,
    help="Retrieval method; `colmap-netvlad methods` lists them.",
)
seed_option = click.option(
    "--seed",
    type=click.IntRange(0, HIGHEST_SEED),
    default=0,
    show_default=True,
    help="Seed of every random choice.",
)
device_option = click.option(
    "--device",
    help="Where networks run: cpu, cuda, cuda:1, mps.  [default: cuda where there is one, else"
    " cpu]",
)
masks_option = click.option(
    "--masks",
    type=FOLDER,
    help="Folder of masks in COLMAP's way (<photo>.png): what is black there is ignored.",
)
pairs_option = click.option(
    "--pairs",
    type=PATH,
    help="Pairs list (COLMAP's, .csv or .json).  [default: what `pairs` wrote last]",
)
sparse_option = click.option(
    "--sparse", type=PATH, required=True, help="A COLMAP model, or a folder of models 0, 1, ..."
)
model_images_option = click.option(
    "--images",
    "--image_path",
    "images",
    type=PATH,
    help="Photo folder, for EXIF GPS and thumbnails.  [default: images beside the database or the"
    " model, where there is one]",
)
model_database_option = click.option(
    "--db",
    "--database_path",
    "database",
    type=FILE,
    help="COLMAP database, for position priors and verified pairs.  [default: project.db or"
    " database.db beside the model's folder, where there is one]",
)
copy_option = click.option(
    "--copy",
    is_flag=True,
    help="Leave the database as it is and write matches into <name>.copy.db beside it.",
)
contradicted_option = click.option(
    "--drop-contradicted/--keep-contradicted",
    default=True,
    show_default=True,
    help="Leave out of the mapping pairs of look-alike places: what the pairs around them or GPS"
    " contradict.",
)
json_option = click.option(
    "--json", "as_json", is_flag=True, help="Print the report as JSON on standard output."
)


def verbose_option(command: Function) -> Function:
    """Add -v, which lets pycolmap's own log through."""

    def set_verbosity(context: click.Context, parameter: click.Parameter, verbose: bool) -> None:
        context.meta[VERBOSE] = verbose

    return click.option(
        "-v",
        "--verbose",
        is_flag=True,
        expose_value=False,
        callback=set_verbosity,
        help="Show COLMAP's own log on standard error.",
    )(command)


def given(*names: str) -> list[str]:
    """Return those of these parameters that stand on the command line."""
    context = click.get_current_context()
    return [
        name for name in names if context.get_parameter_source(name) is ParameterSource.COMMANDLINE
    ]


def refuse(names: list[str], why: str) -> None:
    """Refuse options that would be ignored, in a sentence that names them.

    Raises:
        click.UsageError: there are any.
    """
    if names:
        context = click.get_current_context()
        options = {parameter.name: parameter.opts[0] for parameter in context.command.params}
        raise click.UsageError(f"{', '.join(options[name] for name in names)} {why}")


def bundle(*options: Callable[[Function], Function]) -> Callable[[Any], Decorator]:
    """Return a maker of decorators from options and from a function that gathers their values.

    The function takes the options' values by name and returns what the command gets by name.
    """
    names = [_name(option) for option in options]

    def gathering(gather: Callable[..., dict[str, Any]]) -> Decorator:
        def decorate(command: Callable[..., Any]) -> Callable[..., Any]:
            @functools.wraps(command)
            def gathered(*arguments: Any, **values: Any) -> Any:
                own = {name: values.pop(name) for name in names}
                return command(*arguments, **values, **gather(**own))

            decorated: Callable[..., Any] = gathered
            for option in reversed(options):
                decorated = option(decorated)
            return decorated

        return decorate

    return gathering


def _name(option: Callable[[Any], Any]) -> str:
    """Return the name of an option's value."""

    def probe() -> None:
        pass

    (parameter,) = option(probe).__click_params__
    return str(parameter.name)


@bundle(database_option, images_option, cache_option)
def project_options(
    database: Path | None, images: Path | None, cache: Path | None
) -> dict[str, Any]:
    """--db --images --cache, as `project`."""
    from colmap_netvlad.project import open_project

    return {"project": open_project(database, images, cache)}


@bundle(database_option, images_option, cache_option, copy_option)
def written_project_options(copy: bool, **where: Path | None) -> dict[str, Any]:
    """--db --images --cache --copy, as `project`: of a database that the command writes."""
    from colmap_netvlad.commands.match import working_copy
    from colmap_netvlad.project import open_project

    project = open_project(**where)
    return {"project": working_copy(project) if copy else project}


RETRIEVAL: tuple[Callable[[Any], Any], ...] = (
    click.option(
        "--model",
        type=FILE,
        help="Checkpoint (.safetensors): the deep model of hybrid and of files of descriptors;"
        " instead of any other method, but in compare, where these stay as they are.",
    ),
    click.option(
        "--gps",
        type=click.Choice(GPS_MODES),
        help="Whether positions (priors or EXIF) re-weight the candidates.  [default: auto where"
        " these are compared place by place, else off]",
    ),
    click.option(
        "--rerank",
        type=click.IntRange(min=0),
        default=COMPARED,
        show_default=True,
        help="Most candidates of each image that deep methods compare place by place; 0: none, the"
        " descriptors alone (with --exact the model's as they are, as in the paper).",
    ),
    masks_option,
    click.option("--vocab-tree", type=FILE, help="Vocabulary tree of the method bow."),
    click.option(
        "--exact/--hnsw",
        default=None,
        help="Search by the model's descriptors as they are, exactly or approximately (HNSW)."
        "  [default: by descriptors in words of the flight's own]",
    ),
    device_option,
    seed_option,
)
"""What every command that ranks takes beside the method and k."""

RETRIEVAL_NAMES = ("model", "gps", "rerank", "masks", "vocab_tree", "exact", "device")


@bundle(*RETRIEVAL)
def retrieval_options(**values: Any) -> dict[str, Any]:
    """What every command that ranks takes beside the method and k, as `retrieval`."""
    return {"retrieval": RetrievalOptions(**values)}


MATCHER: tuple[Callable[[Any], Any], ...] = (
    click.option(
        "--matcher",
        help="Who matches: colmap (COLMAP's own), or guided (a glance tells where two photos"
        " overlap, and features are looked for only there)."
        f"  [default: {MATCHER_DEFAULT}]",
    ),
    click.option(
        "--thorough",
        is_flag=True,
        help="Let guided search pairs in full whose glance shows nothing in common, instead of"
        " giving them up, and pairs again that earlier runs left without a match.",
    ),
)


def _match_options(matcher: str | None, thorough: bool, seed: int = 0) -> dict[str, MatchOptions]:
    from colmap_netvlad.matching.matchers import find_matcher

    matching = MatchOptions(matcher, thorough, seed)
    find_matcher(matching)
    return {"matching": matching}


@bundle(*MATCHER)
def matcher_options(matcher: str | None, thorough: bool) -> dict[str, Any]:
    """Who matches, as `matching`; its seed is the retrieval's."""
    return _match_options(matcher, thorough)


@bundle(
    pairs_option,
    click.option(
        "--rounds",
        type=int,
        help="Match in this many rounds, each choosing its pairs by what the earlier ones taught,"
        " instead of a pairs list.",
    ),
    click.option(
        "--budget",
        type=int,
        help="Most pairs that --rounds matches.  [default: k times the number of images]",
    ),
    k_option,
    click.option(
        "--method",
        default="hybrid",
        show_default=True,
        help="Retrieval method of --rounds; `colmap-netvlad methods` lists them.",
    ),
    *RETRIEVAL,
    *MATCHER,
)
def matching_options(
    pairs: Path | None,
    rounds: int | None,
    budget: int | None,
    k: int,
    method: str,
    matcher: str | None,
    thorough: bool,
    **values: Any,
) -> dict[str, Any]:
    """What to match and who does it: a pairs list, or pairs in rounds, as `pairs`, `rounds` and
    `matching`."""
    from colmap_netvlad.commands.match import RoundsOptions

    if rounds is None:
        ignored = given("budget", "k", "method", *RETRIEVAL_NAMES)
        refuse(ignored, "would be ignored: a pairs list is matched as it is; add --rounds.")
    else:
        refuse(given("pairs"), "would be ignored: --rounds choose the pairs; leave one out.")
    retrieval = RetrievalOptions(k=k, **values)
    return {
        "pairs": pairs,
        "rounds": None if rounds is None else RoundsOptions(rounds, budget, method, retrieval),
        **_match_options(matcher, thorough, values["seed"]),
    }


FEATURES: tuple[Callable[[Any], Any], ...] = (
    click.option(
        "--camera",
        default="auto",
        show_default=True,
        help="Which photos share a camera: auto (equal make, model, serial number, focal length and"
        " size; without EXIF equal folder and size), single, per-folder, per-image.",
    ),
    click.option(
        "--camera-model",
        default="SIMPLE_RADIAL",
        show_default=True,
        help="COLMAP's model of new cameras, SIMPLE_RADIAL or OPENCV for example.",
    ),
    click.option(
        "--max-image-size",
        type=int,
        help="Longer side at which SIFT runs, px.  [default: COLMAP's, 3200]",
    ),
    click.option(
        "--max-features",
        default=8192,
        show_default=True,
        help="About the most features of a photo: COLMAP keeps up to three quarters more.",
    ),
    click.option(
        "--threads",
        type=int,
        help="Photos at once.  [default: as processors and memory allow]",
    ),
)


@bundle(*FEATURES)
def feature_options(**values: Any) -> dict[str, Any]:
    """How photos are imported, as `features`; masks are an option of their own."""
    from colmap_netvlad.colmap.features import FeatureOptions

    features: FeatureOptions = FeatureOptions(**values)
    return {"features": features}


GROUND_POINTS: tuple[Callable[[Any], Any], ...] = (
    click.option(
        "--gcp",
        type=FILE,
        help="Ground points in OpenDroneMap's format (system, then x y z px py photo name): they"
        " place the model and are held in a last adjustment.",
    ),
    click.option(
        "--check",
        multiple=True,
        help="Name of a ground point that only checks the model; may be given several times.",
    ),
)


@bundle(*GROUND_POINTS)
def ground_options(gcp: Path | None, check: tuple[str, ...]) -> dict[str, Any]:
    """--gcp --check, as `gcp`."""
    from colmap_netvlad.commands.georegister import ControlFile

    if gcp is None:
        refuse(given("check"), "names points of --gcp; give the list.")
        return {"gcp": None}
    return {"gcp": ControlFile(gcp, check)}


@bundle(
    click.option(
        "--georegister",
        type=click.Choice(["auto", "off", "require"]),
        default="auto",
        show_default=True,
        help="Whether the model is brought into the world, in m, by position priors or EXIF GPS.",
    ),
    click.option(
        "--use-gps",
        is_flag=True,
        help="Adjust with the positions as priors, robustly: against drift and dome-shaped errors,"
        " and for the focal length. Mappers incremental and parallel.",
    ),
    click.option(
        "--gps-std",
        type=(click.FloatRange(min=0, min_open=True),) * 2,
        help="Standard deviations of the positions for --use-gps, m horizontal and vertical."
        "  [default: what the database's priors, XMP (RTK) or EXIF state of each photo, else 3"
        " and 5]",
    ),
)
def place_options(
    georegister: Any, use_gps: bool, gps_std: tuple[float, float] | None
) -> dict[str, Any]:
    """Where in the world the model is, as `world`."""
    from colmap_netvlad.commands.georegister import WorldOptions

    if not use_gps:
        refuse(given("gps_std"), "says how good the positions of --use-gps are; add it.")
    return {"world": WorldOptions(georegister, use_gps, gps_std)}


@bundle(
    click.option(
        "--mapper",
        default="auto",
        show_default=True,
        help="How the model is built: incremental (COLMAP's), parallel (in clusters, for large"
        " flights), hierarchical or global (COLMAP's); auto: incremental for small flights,"
        " parallel for large ones.",
    ),
    click.option(
        "--cluster-size",
        type=click.IntRange(min=3),
        help="Images of a cluster of parallel and hierarchical mapping.  [default: 250]",
    ),
    click.option(
        "--threads", type=click.IntRange(min=1), help="Processors for mapping.  [default: all]"
    ),
    click.option(
        "--memory",
        type=click.FloatRange(min=0, min_open=True),
        help="GiB that the workers of parallel mapping may take.  [default: 70 % of the machine's]",
    ),
)
def mapping_options(
    mapper: str, cluster_size: int | None, threads: int | None, memory: float | None
) -> dict[str, Any]:
    """How the model is built, as `mapper` and `mapping`."""
    from colmap_netvlad.mapping.options import MappingOptions

    limit = None if memory is None else memory * 2**30
    mapping = MappingOptions(threads=threads, cluster_size=cluster_size, memory=limit)
    return {"mapper": mapper, "mapping": mapping}


@bundle(
    click.option(
        "--cluster",
        metavar="auto|HOST:PORT",
        help="Let the machines of a Ray cluster do the work: auto, the one that this machine is in,"
        " or its head. Photos that a machine does not see under the same path are sent to it.",
    )
)
def cluster_option(cluster: str | None) -> dict[str, Any]:
    """--cluster: connected while the command runs. Innermost, after all else is checked."""
    if cluster is not None:
        from colmap_netvlad.runtime.cluster import on_cluster

        click.get_current_context().with_resource(on_cluster(cluster))
    return {}
